"""The nodes of the paper on ROS topics: ROS 2 over Zenoh, without a ROS installation."""
