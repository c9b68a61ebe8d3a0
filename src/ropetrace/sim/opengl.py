"""Depth by MuJoCo's own renderer, where OpenGL is installed: a second opinion on the ray caster.

It needs the extra ``sim``, the package ``pyopengl``, and a library that renders without a screen (Debian: libosmesa6,
or libegl1 libgl1 libgl1-mesa-dri). MuJoCo chooses its OpenGL when it is imported, and dies if
the one it is told of is missing: so it renders in a process of its own, and this process's environment stays as it is.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable
from ctypes.util import find_library

import numpy as np
from numpy.typing import NDArray

from ropetrace.errors import ConfigError, MissingExtraError, import_extra
from ropetrace.sim.scene import FAR, NEAR, Scene
from ropetrace.types import FloatArray, Intrinsics

_LIBRARIES = {"osmesa": ("OSMesa",), "egl": ("EGL", "GL")}


def opengl_backend() -> str | None:
    """What MuJoCo can render with on this machine, as MUJOCO_GL names it; None if there is nothing."""
    for backend, libraries in _LIBRARIES.items():
        if all(find_library(library) for library in libraries):
            return backend
    return None


def render_with_opengl(
    scene: Scene, camera: Intrinsics, world_from_camera: FloatArray | None = None
) -> NDArray[np.float32]:
    """Planar depth by MuJoCo's renderer, which draws capsules as many-sided bodies. Takes about a second.

    Parameters
    ----------
    scene : Scene
        Metres.
    camera : Intrinsics
        With square pixels and the principal point in the middle of the image.
    world_from_camera : (4, 4) float array, optional
        The camera's pose.

    Returns
    -------
    (H, W) float32 array
        Metres; 0 where nothing is seen.

    Raises
    ------
    ConfigError
        If the camera is another one.
    MissingExtraError
        If OpenGL or MuJoCo is not installed, or does not work.
    """
    middle = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    if camera.fx != camera.fy or not np.allclose((camera.cx, camera.cy), middle, atol=1e-6):
        raise ConfigError("OpenGL rendering needs square pixels and the principal point in the middle of the image")
    backend = opengl_backend()
    if backend is None:
        raise MissingExtraError("there is no OpenGL to render with: apt install libosmesa6, pip install pyopengl")
    request = {
        "xml": _model(scene.seen_from(world_from_camera), camera),
        "width": camera.width,
        "height": camera.height,
    }
    done = subprocess.run(
        [sys.executable, "-m", "ropetrace.sim.opengl"],
        input=json.dumps(request).encode(),
        capture_output=True,
        env=os.environ | {"MUJOCO_GL": backend},
        timeout=120,
        check=False,
    )
    expected = camera.width * camera.height * 4
    if done.returncode != 0 or len(done.stdout) != expected:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise MissingExtraError(f"MuJoCo cannot render with {backend}: {lines[-1]}")
    depth = np.frombuffer(done.stdout, np.float32).reshape(camera.height, camera.width).copy()
    depth[depth >= 0.99 * FAR] = 0
    return depth


def _model(scene: Scene, camera: Intrinsics) -> str:
    """The scene, in the camera's frame, as an MJCF model. MuJoCo's cameras look along -z with y up."""
    vertical_fov = math.degrees(2 * math.atan(camera.height / 2 / camera.fy))
    capsules, boxes = scene.capsules, scene.boxes
    geoms = []
    for start, end, radius in zip(capsules.starts, capsules.ends, capsules.radii, strict=True):
        if np.array_equal(start, end):
            geoms.append(f'<geom type="sphere" size="{radius:.17g}" pos="{_text(start)}"/>')
        else:
            geoms.append(f'<geom type="capsule" size="{radius:.17g}" fromto="{_text([*start, *end])}"/>')
    for center, rotation, half in zip(boxes.centers, boxes.rotations, boxes.half_sizes, strict=True):
        axes = _text([*rotation[:, 0], *rotation[:, 1]])
        geoms.append(f'<geom type="box" size="{_text(half)}" pos="{_text(center)}" xyaxes="{axes}"/>')
    for plane in scene.planes:
        normal = np.array(plane.normal)
        point = normal * plane.distance / (normal @ normal)
        # MuJoCo draws a plane from its front only, which is where its normal points.
        facing = normal if point @ normal < 0 else -normal
        geoms.append(f'<geom type="plane" size="0 0 0.1" pos="{_text(point)}" zaxis="{_text(facing)}"/>')
    return f"""
        <mujoco>
          <statistic extent="1" center="0 0 1"/>
          <visual>
            <map znear="{NEAR}" zfar="{FAR}"/>
            <quality numslices="128" numstacks="64" offsamples="0"/>
            <global offwidth="{camera.width}" offheight="{camera.height}"/>
          </visual>
          <worldbody>
            <camera name="camera" pos="0 0 0" xyaxes="1 0 0 0 -1 0" fovy="{vertical_fov:.17g}"/>
            {"".join(geoms)}
          </worldbody>
        </mujoco>"""


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.17g}" for number in numbers)


def _render_request() -> None:
    """The other process: a request as JSON comes in, depth as float32 goes out."""
    mujoco = import_extra("mujoco", "sim")
    request = json.load(sys.stdin)
    model = mujoco.MjModel.from_xml_string(request["xml"])
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, request["height"], request["width"])
    try:
        renderer.enable_depth_rendering()
        renderer.update_scene(data, "camera")
        sys.stdout.buffer.write(np.ascontiguousarray(renderer.render(), np.float32).tobytes())
        sys.stdout.flush()
    finally:
        renderer.close()


if __name__ == "__main__":
    _render_request()
