"""From files to typed masks: foreground, ignored, missing; and nothing is guessed in silence."""

import cv2
import numpy as np
import pytest
import torch

from datamodules import load
from tests.datamodules.layouts.prepared_writer import write
from visdom_plugin.errors import SceneError
from visdom_plugin.scene import describe_masks

VIEW = "train_002"


def add_alpha(folder, masks, change=None):
    """Photographs become RGBA; what is transparent becomes black, as renderers leave it."""
    for path in sorted((folder / "images").iterdir()):
        image = cv2.imread(str(path))
        alpha = masks(path.stem).astype(np.uint8) * 255
        alpha = alpha if change is None else change(alpha)
        write(path, np.dstack([image * (alpha[..., None] > 0), alpha]))


def truth(tiny):
    return {n: v.masks[i].numpy() for v in (tiny.train, tiny.test) for i, n in enumerate(v.names)}.__getitem__


def empty(folder):
    for path in folder.iterdir():
        path.unlink()
    folder.rmdir()


@pytest.mark.parametrize("way", ["{}.png", "{}.png.png", "{}_mask.png"])
def test_names(tiny, folder, way):
    for path in sorted((folder / "masks").iterdir()):
        path.rename(path.with_name(way.format(path.stem)))
    scene = load(folder)
    assert all(map(torch.equal, scene.train.masks, tiny.train.masks))
    assert all(map(torch.equal, scene.test.masks, tiny.test.masks))
    assert describe_masks(scene.train) == ["4 foreground masks; the background is known to be empty"]


@pytest.mark.parametrize("factor", [2, 3])
def test_larger_and_smaller_masks_of_the_same_picture(tiny, folder, factor):
    path = folder / f"masks/{VIEW}.png"
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    write(path, np.kron(mask, np.ones((factor, factor), np.uint8)))
    assert all(map(torch.equal, load(folder).train.masks, tiny.train.masks))
    write(path, mask[::2, ::2])
    small = load(folder).train.masks[2]
    assert torch.equal(small, tiny.train.masks[2][::2, ::2].repeat_interleave(2, 0).repeat_interleave(2, 1))


def test_soft_masks_are_cut_at_one_half_and_said(tiny, folder):
    assert not any("soft" in note for note in load(folder).notes)
    for i, name in enumerate(tiny.train.names):
        mask = tiny.train.masks[i].numpy()
        soft = np.where(mask, 140, 110).astype(np.uint8)
        soft[:, :24] = mask[:, :24] * 255
        write(folder / f"masks/{name}.png", soft)
    scene = load(folder)
    assert all(map(torch.equal, scene.train.masks, tiny.train.masks))
    assert any("50.0% of their pixels are neither black nor white, cut at one half" in n for n in scene.notes)


def test_label_images_are_read_and_said(tiny, folder):
    for i, name in enumerate(tiny.train.names[:3]):
        labels = tiny.train.masks[i].numpy() * np.uint8([1, 2, 40][i])
        write(folder / f"masks/{name}.png", labels)
    scene = load(folder)
    assert all(map(torch.equal, scene.train.masks, tiny.train.masks))
    said = "3 of 4 training views: label images read as masks: 0 is background, every other value is object"
    assert said in scene.notes


def test_void_of_label_images_is_ignored_in_every_view(tiny, folder):
    for views in (tiny.train, tiny.test):
        for mask, name in zip(views.masks, views.names, strict=True):
            labels = mask.numpy() * np.uint8(7)
            labels[:3] = 255
            write(folder / f"masks/{name}.png", labels)
    scene = load(folder)
    assert any("their value for void is unknown, as in ignore/" in note for note in scene.notes)
    for ours, theirs in ((scene.train, tiny.train), (scene.test, tiny.test)):
        for i, mask in enumerate(theirs.masks):
            assert ours.ignored(i)[:3].all() and not ours.ignored(i)[3:].any()
            assert torch.equal(ours.masks[i][3:], mask[3:])


def test_the_alpha_channel_is_the_mask_where_there_is_no_other(tiny, folder):
    add_alpha(folder, truth(tiny))
    empty(folder / "masks")
    scene = load(folder)
    for ours, theirs in ((scene.train, tiny.train), (scene.test, tiny.test)):
        assert all(map(torch.equal, ours.masks, theirs.masks))
    assert not scene.train.mask_origins
    with pytest.raises(SceneError, match="mask"):
        load(folder, mask_source="folder")


def test_alpha_and_file_must_agree_or_be_chosen_between(tiny, folder):
    add_alpha(folder, truth(tiny))
    assert all(map(torch.equal, load(folder).train.masks, tiny.train.masks))
    add_alpha(folder, truth(tiny), lambda alpha: np.roll(alpha, 9, 1))
    with pytest.raises(
        SceneError, match=r"train_000\.png and the alpha channel of train_000\.png[\s\S]*mask-source"
    ):
        load(folder)
    by_file, by_alpha = load(folder, mask_source="folder").train, load(folder, mask_source="alpha").train
    assert all(map(torch.equal, by_file.masks, tiny.train.masks))
    assert torch.equal(by_alpha.masks[0], tiny.train.masks[0].roll(9, 1))


def test_a_cut_out_keeps_its_colours_when_it_shrinks(tiny, folder):
    """One colour on transparent black stays that colour at the edges of a smaller picture."""
    add_alpha(folder, truth(tiny))
    empty(folder / "masks")
    for path in (folder / "images").iterdir():
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        image[..., :3] = np.where(image[..., 3:] > 0, (30, 120, 200), 0)
        write(path, image)
    train = load(folder, downscale=2.6).train
    for image, mask in zip(train.images, train.masks, strict=True):
        assert (image[mask].float() - torch.tensor([200.0, 120, 30])).abs().max() <= 1


def test_the_folder_ignore_is_unknown_and_not_background(tiny, folder):
    (folder / "ignore").mkdir()
    unknown = np.zeros(tiny.train.masks[2].shape, np.uint8)
    unknown[10:20, 5:30] = 255
    write(folder / f"ignore/{VIEW}.png", unknown)
    train = load(folder).train
    assert [train.ignored(i) is not None for i in range(4)] == [False, False, True, False]
    assert torch.equal(train.ignored(2), torch.from_numpy(unknown) > 0)
    assert all(map(torch.equal, train.masks, tiny.train.masks)), "the foreground is another matter"
    assert "1 view with ignored pixels" in describe_masks(train)[1]
    _, carving, _ = train.silhouettes()
    assert carving[2][10:20, 5:30].all()
    half = load(folder, downscale=2.6).train
    assert half.ignored(2).float().mean() >= train.ignored(2).float().mean(), "unknown in part is unknown"


def test_views_without_a_mask_come_back_as_missing(tiny, folder):
    for name in (VIEW, "test_001"):
        (folder / f"masks/{name}.png").unlink()
    with pytest.raises(SceneError, match=r"no mask[\s\S]*--data\.missing-masks colour"):
        load(folder)
    scene = load(folder, allow_missing_masks=True)
    assert [scene.train.mask_origin(i) for i in range(4)] == ["given", "given", "missing", "given"]
    assert [scene.test.mask_origin(i) for i in range(3)] == ["given", "missing", "given"]
    assert scene.train.masks[2].all() and torch.equal(scene.train.masks[0], tiny.train.masks[0])
    assert describe_masks(scene.train)[1] == "1 view without a mask"
