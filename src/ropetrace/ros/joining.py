"""Which way leads into the ROS graph of this machine."""

from __future__ import annotations

import os
from importlib.util import find_spec
from typing import Literal

from ropetrace.errors import ConfigError

Way = Literal["zenoh", "rclpy", "rospy"]


def best_way() -> Way:
    """rclpy where it can be imported; else rospy, where it can be and ROS_MASTER_URI is set; else Zenoh."""
    if find_spec("rclpy") is not None:
        return "rclpy"
    return "rospy" if os.environ.get("ROS_MASTER_URI") and find_spec("rospy") is not None else "zenoh"


def domain_of_environment() -> int:
    """ROS_DOMAIN_ID, or 0.

    Raises
    ------
    ConfigError
        If it is no number.
    """
    text = os.environ.get("ROS_DOMAIN_ID", "") or "0"
    if not text.isdecimal():
        raise ConfigError(f"ROS_DOMAIN_ID = {text!r}: expected a number")
    return int(text)
