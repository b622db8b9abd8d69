from dataclasses import dataclass

from visdom_plugin.registry import MethodSpec, SamplerMethodConfig


@dataclass(frozen=True)
class Config(SamplerMethodConfig):  # which has mask_weight, hull and vd
    steps: int = 300
    rays: int = 512  # per step
    samples: int = 48  # along each ray
    resolution: int = 64
    radius: float = 0.4  # of what is seen, in mean distances of the cameras


SPEC = MethodSpec("my-method", "my_method.field:Field", Config(), hook="sampler", description="A voxel grid")
