"""A film of several agents, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flowpolicy_envs.square.rendering import RENDER_FPS
from sb3_flowpolicy.common.files import replacing
from sb3_flowpolicy.experiments.square_pictures.record import Recording

_HEAD = 20
"""Height of the labels in pixels."""


def write_film(recordings: Sequence[Recording], path: Path) -> None:
    """Write the agents' episodes as an animated WebP in real time, an image for browsers.

    An episode that ends early rests on its last frame.
    """
    from PIL import Image, ImageDraw

    size = recordings[0].frames[0].shape[1]
    pictures = []
    for k in range(max(len(recording.frames) for recording in recordings)):
        row = [recording.frames[min(k, len(recording.frames) - 1)] for recording in recordings]
        picture = Image.new("RGB", (size * len(row), size + _HEAD), "white")
        picture.paste(Image.fromarray(np.hstack(row)), (0, _HEAD))
        for column, recording in enumerate(recordings):
            label = f"{recording.label}: {recording.origin}"
            ImageDraw.Draw(picture).text((size * column + 6, 4), label, "black", font_size=13)
        pictures.append(picture)
    with replacing(path) as draft:
        pictures[0].save(
            draft,
            save_all=True,
            append_images=pictures[1:],
            duration=round(1000 / RENDER_FPS),
            loop=0,
            quality=60,
            method=6,  # slow and small
        )
