"""Frames to an MP4 that plays anywhere, H.264 in yuv420p, and frames of anybody's video, by PyAV (FFmpeg's libraries)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np

from pipeline.atomic import atomic_path
from pipeline.errors import UserError

QUALITY = "16"  # x264's constant rate factor: differences are not seen


def write_video(path: Path, frames: Iterable[np.ndarray], fps: int = 24) -> int:
    """(H, W, 3) uint8 sRGB frames of one even size, taken one by one, as an MP4 file; returns how many there were.

    The file appears whole or not at all.
    """
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    count = 0
    try:
        options = {"movflags": "faststart"}
        with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4", options=options) as file:
            stream = file.add_stream("libx264", rate=fps, options={"crf": QUALITY, "preset": "medium"})
            stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, fps)
            context = stream.codec_context
            context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU709
            context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1  # sRGB
            for frame in frames:
                if count == 0:
                    stream.height, stream.width = frame.shape[:2]
                picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
                picture = picture.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
                picture.pts = count
                file.mux(stream.encode(picture))
                count += 1
            file.mux(stream.encode())
    except (av.error.FFmpegError, OSError) as error:
        raise UserError(f"{path} cannot be written ({error}): give a file in an existing folder") from error
    return count


def frame_count(path: Path) -> int:
    """How many frames the video at ``path`` has, without decoding them; raises UserError."""
    import av

    try:
        with av.open(str(path)) as file:
            return sum(packet.size > 0 for packet in file.demux(file.streams.video[0]))
    except (av.error.FFmpegError, IndexError) as error:
        raise UserError(f"{str(path)!r} is no video that can be read: {error}") from None


def read_video(path: Path) -> Iterator[np.ndarray]:
    """(H, W, 3) uint8 frames of the video at ``path``, upright as a player shows them; raises UserError."""
    import av

    try:
        with av.open(str(path)) as file:
            for frame in file.decode(file.streams.video[0]):
                yield np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90) % 4)
    except (av.error.FFmpegError, IndexError) as error:
        raise UserError(f"{str(path)!r} is no video that can be read: {error}") from None
