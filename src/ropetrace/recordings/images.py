"""Depth and colour images from PNG and JPEG bytes, and back.

Pillow notices only some damaged bits of a PNG and allocates what the header declares, so PNG files are
checked here before Pillow sees them.
"""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ropetrace.errors import FrameError
from ropetrace.recordings.base import one_line
from ropetrace.types import MAX_IMAGE_PIXELS

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8\xff"

Result = TypeVar("Result")

_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
_BIT_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
# What the pixels are made of. Nothing else of a PNG is decoded: profiles and texts can be bombs.
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"IDAT", b"IEND")


@dataclass(frozen=True, slots=True)
class PngHeader:
    """What the header of a PNG declares; sizes in pixels, `color_type` as in the PNG specification."""

    width: int
    height: int
    bit_depth: int
    color_type: int


def check_png(data: bytes) -> PngHeader:
    """Check the structure, the declared size and every checksum of a PNG, without decoding it.

    Raises
    ------
    FrameError
        If it is damaged, truncated, or too large.
    """
    return _pixel_chunks(data)[0]


def _pixel_chunks(data: bytes) -> tuple[PngHeader, list[tuple[bytes, bytes]]]:
    """The header, and the name and bytes of each chunk that makes the pixels."""
    if not data.startswith(PNG_SIGNATURE):
        raise FrameError("not a PNG: the signature is missing or damaged")
    header: PngHeader | None = None
    kept: list[tuple[bytes, bytes]] = []
    offset = len(PNG_SIGNATURE)
    while not kept or kept[-1][0] != b"IEND":
        if offset + 12 > len(data):
            raise FrameError("the PNG is truncated: it has no end marker")
        length, name = struct.unpack_from(">I4s", data, offset)
        end = offset + 12 + length
        if end > len(data):
            raise FrameError(f"the PNG is truncated or damaged in its chunk {name!r} at byte {offset}")
        if zlib.crc32(memoryview(data)[offset + 4 : end - 4]) != struct.unpack_from(">I", data, end - 4)[0]:
            raise FrameError(f"the PNG is damaged: wrong checksum of its chunk {name!r} at byte {offset}")
        if header is None:
            if name != b"IHDR" or length != 13:
                raise FrameError("the PNG is damaged: it does not begin with its header")
            header = _png_header(data[offset + 8 : offset + 21])
        if name in _PIXEL_CHUNKS:
            kept.append((name, data[offset:end]))
        offset = end
    assert header is not None
    return header, kept


def _checked_pixels(header: PngHeader, chunks: list[tuple[bytes, bytes]]) -> bytes:
    """A PNG of nothing but the pixels, all of which are there: Pillow makes up what is missing."""
    row_bits = header.width * header.bit_depth * _CHANNELS[header.color_type]
    expected = header.height * (1 + (row_bits + 7) // 8)
    packed = b"".join(chunk[8:-4] for name, chunk in chunks if name == b"IDAT")
    inflate = zlib.decompressobj()
    try:
        found = len(inflate.decompress(packed, expected + 1))
    except zlib.error as error:
        raise FrameError(f"the PNG is damaged: {error}") from None
    if found != expected or not inflate.eof:
        raise FrameError(f"the PNG is damaged: its pixels are not the {expected} bytes that its header declares")
    return PNG_SIGNATURE + b"".join(chunk for _, chunk in chunks)


def _png_header(payload: bytes) -> PngHeader:
    width, height, bit_depth, color_type, compression, filtering, interlace = struct.unpack(">IIBBBBB", payload)
    if not width or not height or width * height > MAX_IMAGE_PIXELS:
        raise FrameError(f"the PNG declares {width}x{height}: 1 to {MAX_IMAGE_PIXELS} pixels in all are taken")
    if bit_depth not in _BIT_DEPTHS.get(color_type, ()) or compression or filtering:
        raise FrameError(f"the PNG declares an unknown format (colour type {color_type}, {bit_depth} bits)")
    if interlace:
        raise FrameError("the PNG is interlaced, which is not read: save it without")
    return PngHeader(width, height, bit_depth, color_type)


def decode_depth(data: bytes) -> NDArray[np.uint16]:
    """Depth from a 16-bit grey PNG.

    Returns
    -------
    (H, W) uint16 array
        The stored values.

    Raises
    ------
    FrameError
        If the image is damaged or is not 16-bit grey.
    """
    header, chunks = _pixel_chunks(data)
    if header.color_type != 0:
        raise FrameError(f"{_CHANNELS[header.color_type]}-channel or palette PNG; depth needs 16-bit grey PNG")
    if header.bit_depth != 16:
        raise FrameError(f"{header.bit_depth}-bit; depth needs 16-bit PNG")
    depth = _decoded(_checked_pixels(header, chunks), "PNG")
    if depth.shape != (header.height, header.width) or depth.dtype.kind not in "iu":
        raise FrameError(f"decoded to {depth.dtype} of shape {depth.shape}; depth needs 16-bit grey PNG")
    return np.ascontiguousarray(depth, dtype=np.uint16)


def decode_color(data: bytes) -> NDArray[np.uint8]:
    """Colour from a PNG of 8 bits a channel or a JPEG.

    Returns
    -------
    (H, W, 3) uint8 array
        sRGB; a grey image has three equal channels, transparency is dropped.

    Raises
    ------
    FrameError
        If the image is damaged, too large, or of another format.
    """
    if data.startswith(JPEG_SIGNATURE):
        return _decoded(data, "JPEG", "RGB")
    header, chunks = _pixel_chunks(data)
    if header.bit_depth > 8:
        raise FrameError(f"{header.bit_depth}-bit; colour needs 8 bits a channel")
    return _decoded(_checked_pixels(header, chunks), "PNG", "RGB")


def jpeg_size(data: bytes) -> tuple[int, int]:
    """Width and height that a JPEG declares, pixels.

    Raises
    ------
    FrameError
        If its header is damaged.
    """
    return _from_pillow(data, "JPEG", lambda image: (image.width, image.height))


def _decoded(data: bytes, kind: str, mode: str | None = None) -> NDArray[Any]:
    return _from_pillow(data, kind, lambda image: np.array(image.convert(mode) if mode else image))


def _from_pillow(data: bytes, kind: str, take: Callable[[Image.Image], Result]) -> Result:
    """What `take` makes of an image of bounded size; whatever Pillow raises means a damaged image."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(data), formats=(kind,)) as image:
                if not 0 < image.width * image.height <= MAX_IMAGE_PIXELS:
                    raise FrameError(f"the {kind} declares {image.width}x{image.height}: too large")
                return take(image)
    except FrameError:
        raise
    except Exception as error:
        raise FrameError(f"the {kind} is damaged: {one_line(error)}") from None


def encode_png(pixels: NDArray[Any]) -> bytes:
    """PNG bytes of an (H, W) uint16 or an (H, W, 3) uint8 array, quickly rather than small."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "PNG", compress_level=1)
    return stream.getvalue()
