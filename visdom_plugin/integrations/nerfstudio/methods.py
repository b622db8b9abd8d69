"""What `ns-train` offers: nerfacto-vd, instant-ngp-vd, splatfacto-vd.

Schedules and sizes are those of nerfstudio 1.1.5's own nerfacto, instant-ngp and splatfacto. They are written down
here because nerfstudio looks for plugins while it builds its own, so that these cannot be copied.
"""

from __future__ import annotations

import _codecs

import numpy as np
import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.pipelines.dynamic_batch import DynamicBatchPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from visdom_plugin.integrations.nerfstudio.dataparser import VisdomDataParserConfig
from visdom_plugin.integrations.nerfstudio.fields import InstantNgpVdConfig, NerfactoVdConfig
from visdom_plugin.integrations.nerfstudio.splats import SplatfactoVdConfig

# Since 2.6 torch loads tensors and plain data only, and nerfstudio's own checkpoints hold their learning rates as
# numpy numbers. Allowing these is what ns-eval, ns-viewer and --load-dir need, for every method. Numpy is below 2.
torch.serialization.add_safe_globals(
    [np.core.multiarray.scalar, np.dtype, type(np.dtype(np.float64)), _codecs.encode]  # type: ignore[attr-defined]
)


def _group(lr: float, lr_final: float | None = None, steps: int = 200_000, **warm_up) -> dict:
    """Adam with an exponential decay, or with a constant rate."""
    schedule = None
    if lr_final is not None:
        schedule = ExponentialDecaySchedulerConfig(lr_final=lr_final, max_steps=steps, **warm_up)
    return {"optimizer": AdamOptimizerConfig(lr=lr, eps=1e-15), "scheduler": schedule}


def _rays() -> VanillaDataManagerConfig:
    return VanillaDataManagerConfig(
        dataparser=VisdomDataParserConfig(background="alpha"),
        train_num_rays_per_batch=4096,
        eval_num_rays_per_batch=4096,
    )


NERFACTO = MethodSpecification(
    config=TrainerConfig(
        method_name="nerfacto-vd",
        steps_per_eval_batch=500,
        steps_per_save=2000,
        max_num_iterations=30_000,
        mixed_precision=True,
        pipeline=VanillaPipelineConfig(
            datamanager=_rays(),
            model=NerfactoVdConfig(
                eval_num_rays_per_chunk=1 << 15,
                average_init_density=0.01,
                # The hull is carved from the cameras as they are; four views do not correct them.
                camera_optimizer=CameraOptimizerConfig(mode="off"),
            ),
        ),
        optimizers={
            "proposal_networks": _group(1e-2, 1e-4),
            "fields": _group(1e-2, 1e-4),
            "camera_opt": _group(1e-3, 1e-4, 5000),
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="Nerfacto with rays confined to the visible domain of masked photographs (visdom-plugin)",
)

INSTANT_NGP = MethodSpecification(
    config=TrainerConfig(
        method_name="instant-ngp-vd",
        steps_per_eval_batch=500,
        steps_per_save=2000,
        max_num_iterations=30_000,
        mixed_precision=True,
        pipeline=DynamicBatchPipelineConfig(
            datamanager=_rays(), model=InstantNgpVdConfig(eval_num_rays_per_chunk=8192)
        ),
        optimizers={"fields": _group(1e-2, 1e-4)},
        viewer=ViewerConfig(num_rays_per_chunk=1 << 12),
        vis="viewer",
    ),
    description="Instant-NGP with rays confined to the visible domain of masked photographs (visdom-plugin)",
)

SPLATFACTO = MethodSpecification(
    config=TrainerConfig(
        method_name="splatfacto-vd",
        steps_per_eval_image=100,
        steps_per_eval_batch=0,
        steps_per_save=2000,
        steps_per_eval_all_images=1000,
        max_num_iterations=30_000,
        mixed_precision=False,
        pipeline=VanillaPipelineConfig(
            datamanager=FullImageDatamanagerConfig(
                dataparser=VisdomDataParserConfig(background="alpha"), cache_images_type="uint8"
            ),
            model=SplatfactoVdConfig(),
        ),
        optimizers={
            "means": _group(1.6e-4, 1.6e-6, 30_000),
            "features_dc": _group(0.0025),
            "features_rest": _group(0.0025 / 20),
            "opacities": _group(0.05),
            "scales": _group(0.005),
            "quats": _group(0.001),
            "camera_opt": _group(1e-4, 5e-7, 30_000, warmup_steps=1000, lr_pre_warmup=0),
            "bilateral_grid": _group(2e-3, 1e-4, 30_000, warmup_steps=1000, lr_pre_warmup=0),
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="viewer",
    ),
    description="Splatfacto from the hull of masked photographs, kept inside it (visdom-plugin)",
)
