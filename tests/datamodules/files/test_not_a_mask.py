"""Photographs given as masks are refused; soft masks of every kind are not."""

import cv2
import numpy as np
import pytest

from datamodules import load
from datamodules.files.not_a_mask import is_colourful, refuse_photograph
from tests.datamodules.layouts.prepared_writer import write
from visdom_plugin.errors import SceneError


@pytest.fixture(scope="module")
def picture():
    """A photograph (H, W, 3) with texture everywhere, and its true mask."""
    random = np.random.default_rng(0)
    rough = cv2.GaussianBlur(random.uniform(0, 1, (120, 160, 3)).astype(np.float32), (0, 0), 4)
    rough = (rough - rough.min()) / np.ptp(rough)
    mask = np.zeros((120, 160), np.float32)
    cv2.circle(mask, (80, 60), 30, 1.0, -1)
    return (255 * (0.15 + 0.6 * rough)).astype(np.uint8), mask


def spoil(folder, make, ending="png"):
    """Masks made of their photographs, BGR."""
    for path in (folder / "masks").iterdir():
        image = cv2.imread(str(folder / "images" / path.name))
        mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        path.unlink()
        write(path.with_suffix(f".{ending}"), make(image, mask))


@pytest.mark.parametrize("ending", ["png", "jpg"])
@pytest.mark.parametrize(
    "make",
    [
        lambda image, mask: image,
        lambda image, mask: cv2.cvtColor(image, cv2.COLOR_BGR2GRAY),
        lambda image, mask: image * (mask[..., None] > 0),
        lambda image, mask: np.where(mask[..., None] > 0, image, 255),
        lambda image, mask: cv2.resize(image, None, fx=2, fy=2),
        lambda image, mask: image[:, ::-1],
    ],
    ids=["same", "grey", "cut out on black", "cut out on white", "larger", "of another view"],
)
def test_photographs_as_masks_are_refused(tiny, folder, make, ending):
    spoil(folder, make, ending)
    with pytest.raises(SceneError, match="the mask is a photograph") as caught:
        load(folder)
    assert "masks" in str(caught.value.where) and caught.value.topic == "mask-grey"
    assert "alpha channel" in caught.value.cause and "--masks" in caught.value.todo


def test_a_folder_of_photographs_named_as_masks_is_refused(tiny, folder):
    with pytest.raises(SceneError, match=r"the mask is a photograph.*; the same of 3 other views"):
        load(folder, masks="images")
    with pytest.raises(SceneError, match="the mask is a photograph"):
        load(folder, masks="images", invert_masks=True)


def test_a_photograph_in_colour_among_the_masks_for_testing_is_refused_before_training(tiny, folder):
    name = tiny.test.names[0]
    image = cv2.imread(str(folder / f"images/{name}.png"))
    write(folder / f"masks/{name}.png", image)
    assert load(folder, test=False)
    with pytest.raises(SceneError, match="the mask is a photograph"):
        load(folder)


def mattes(image, mask):
    rows = np.linspace(0, 1, mask.shape[1], dtype=np.float32)[None]
    return {
        "blurred": cv2.GaussianBlur(mask, (0, 0), 8),
        "of little contrast": np.where(mask > 0, 0.55, 0.45),
        "uncertain": np.clip(mask + 0.2 * np.random.default_rng(1).standard_normal(mask.shape), 0, 1),
        "a gradient": mask * (0.4 + 0.5 * rows),
        "half transparent": 0.6 * mask,
    }


@pytest.mark.parametrize("kind", mattes(*2 * [np.zeros((2, 2), np.float32)]))
def test_soft_masks_pass(picture, kind):
    photograph, mask = picture
    matte = mattes(photograph, mask)[kind].astype(np.float32)
    refuse_photograph(matte, False, photograph, "m.png")
    # The object against a plain wall, as dark and as bright as can be: the photograph is all but the mask.
    plain = np.repeat(np.where(mask > 0, 230, 20).astype(np.uint8)[..., None], 3, 2)
    refuse_photograph(matte, False, plain, "m.png")
    refuse_photograph(matte, False, 255 - plain, "m.png")


def test_masks_in_one_colour_are_no_photographs(picture):
    photograph, mask = picture
    painted = cv2.GaussianBlur(mask, (0, 0), 3)[..., None] * np.array([30.0, 144.0, 200.0])
    assert not is_colourful(painted.astype(np.uint8)) and is_colourful(photograph)
    assert is_colourful(photograph.astype(np.uint16) * 257)
    assert not is_colourful(photograph[..., 0])


def test_soft_masks_are_warned_of_and_named_by_the_scene(tiny, folder, caplog):
    assert load(folder).grey_masks == {} and "doubtful" not in caplog.text
    name = tiny.train.names[1]
    write(folder / f"masks/{name}.png", np.where(tiny.train.masks[1].numpy(), 140, 110).astype(np.uint8))
    scene = load(folder)
    assert scene.grey_masks == {f"{name}.png": 1.0}
    assert "1 of 4 masks are doubtful" in caplog.text
