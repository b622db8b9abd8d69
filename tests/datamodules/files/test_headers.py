"""What a header says agrees with what is decoded, wherever in the file it stands."""

import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, PngImagePlugin

from datamodules.files import images, masks

WHERE = Path("photo.png")


def _with_hole(mode: str, rng: np.random.Generator) -> Image.Image:
    """A picture of noise of which a part is transparent by the means of its mode."""
    rgba = rng.integers(1, 256, (14, 19, 4)).astype(np.uint8)
    rgba[..., 3] = 255
    rgba[3:8, 5:12, 3] = 0
    if mode in ("RGBA", "LA"):
        return Image.fromarray(rgba, "RGBA").convert(mode)
    if mode == "P":
        index = rng.integers(0, 16, (14, 19)).astype(np.uint8)
        index[rgba[..., 3] == 0] = 16
        picture = Image.fromarray(index, "P")
        picture.putpalette(rng.integers(0, 256, 51).astype(np.uint8).tobytes())
        picture.info["transparency"] = 16
        return picture
    colours = rgba[..., :3].copy()
    colours[rgba[..., 3] == 0] = 0
    picture = Image.fromarray(colours if mode == "RGB" else colours[..., 0])
    picture.info["transparency"] = (0, 0, 0) if mode == "RGB" else 0
    return picture


@settings(max_examples=40, deadline=None)
@given(
    mode=st.sampled_from(["RGBA", "LA", "P", "RGB", "L"]),
    profile=st.integers(0, 9000),
    comment=st.integers(0, 9000),
    seed=st.integers(0, 2**20),
)
def test_transparency_is_found_behind_profiles_and_comments(mode, profile, comment, seed):
    rng = np.random.default_rng(seed)
    picture, notes = _with_hole(mode, rng), PngImagePlugin.PngInfo()
    notes.add_text("Comment", rng.bytes(comment).hex())
    stream = io.BytesIO()
    options = {"icc_profile": rng.bytes(profile)} if profile else {}
    if "transparency" in picture.info:
        options["transparency"] = picture.info["transparency"]
    picture.save(stream, "PNG", pnginfo=notes, **options)
    header = images.read_header(stream.getvalue(), WHERE)
    assert header.size == (19, 14) and header.alpha
    found = masks.decode_alpha(images.decode_any(stream.getvalue(), WHERE))
    assert (
        found is not None
        and not (found.opacity[3:8, 5:12] > 0.5).any()
        and (found.opacity > 0.5).mean() > 0.8
    )


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "1", "I;16"])
def test_no_transparency_is_promised_where_there_is_none(mode):
    rng = np.random.default_rng(0)
    grey = Image.fromarray(rng.integers(0, 256, (9, 7)).astype(np.uint8))
    picture = Image.fromarray(np.ones((9, 7), np.uint16)) if mode == "I;16" else grey.convert(mode)
    stream = io.BytesIO()
    # The letters of a chunk's name in a comment are no chunk.
    notes = PngImagePlugin.PngInfo()
    notes.add_text("Comment", "tRNS")
    picture.save(stream, "PNG", pnginfo=notes)
    assert images.read_header(stream.getvalue(), WHERE) == images.Header((7, 9), False)
