"""A set of Gaussians whose attributes a neural field predicts."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Generator, Tensor

from visdom_plugin.methods.splats.splatfields.config import SplatFieldsConfig
from visdom_plugin.methods.splats.splatfields.field import TriplaneField
from visdom_plugin.nerf.optimiser import FieldOptimiser
from visdom_plugin.splat.gaussians import Gaussians
from visdom_plugin.splat.model import GaussianSet

_PREFIX = "field."


class FieldSet(GaussianSet):
    """See `GaussianSet`. A Gaussian's own values are those at the start or after a split, and learn nothing; the
    field learns what to add to them."""

    def __init__(
        self,
        config: SplatFieldsConfig,
        xyz: Tensor,
        rgb: Tensor,
        *,
        extent: float,
        device: torch.device,
        unit: float,
        generator: Generator,
    ):
        super().__init__(config, xyz, rgb, extent=extent, device=device, unit=unit)
        own = self.optimiser.parameters
        harmonics = own["sh"].shape[1]
        self.settings = config
        self.field = TriplaneField(config, own["means"].cpu(), harmonics, self.extent, generator).to(device)
        named = dict(self.field.named_parameters())
        self.field_optimiser = FieldOptimiser([(named, 0.0)], betas=(0.9, 0.999), eps=1e-15)
        self._planes: Tensor | None = None

    @property
    def means(self) -> Tensor:
        """(N, 3) centres as drawn, in the cameras' frame, outside the graph."""
        with torch.no_grad():
            return self.gaussians().means * self.unit

    def gaussians(self) -> Gaussians:
        """The Gaussians as drawn, in the set's own unit, attached to the field."""
        own = super().gaussians()
        if torch.is_grad_enabled():
            return self.field(own, self.field.planes())
        # Many pictures are drawn between two steps.
        if self._planes is None:
            self._planes = self.field.planes()
        return self.field(own, self._planes)

    def optimise(self, step: int) -> None:
        """One Adam step of the field."""
        c = self.settings
        t = min((step + 1) / c.lr_field_steps, 1.0)
        self.field_optimiser.step(c.lr_field ** (1 - t) * c.lr_field_final**t)
        self._planes = None

    def state_dict(self) -> dict[str, Tensor]:
        """Own parameters, those of the field, and both's moments."""
        field = self.field_optimiser.state_dict()
        return super().state_dict() | {_PREFIX + name: value for name, value in field.items()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Takes over what `state_dict` gave; the number of Gaussians may differ."""
        super().load_state_dict(state)
        field = {k.removeprefix(_PREFIX): v for k, v in state.items() if k.startswith(_PREFIX)}
        self.field_optimiser.load_state_dict(field)
        self._planes = None
