"""Models and rays as nerfstudio makes them."""

import torch

from visdom_plugin.hull.domain import VisibleDomain

HULL = VisibleDomain(resolution=48)


def pixel_rays(outputs, camera=0):
    """All rays of a camera, as nerfstudio makes them."""
    return outputs.cameras.generate_rays(camera_indices=camera, keep_shape=True).flatten()


def build(config, train, masks=True):
    torch.manual_seed(0)
    return config.setup(
        scene_box=train.scene_box,
        num_train_data=len(train.image_filenames),
        metadata=train.metadata if masks else {},
        device="cpu",
        grad_scaler=None,
        seed_points=None,
    )
