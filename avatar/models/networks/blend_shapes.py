"""Blend shapes of the Gaussians: residuals of position and colour that the mesh leaves over."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float, Int, Int64
from torch import Tensor, nn

from avatar.models.networks.config_dict import MOST_LAYERS
from smplxpp.core import InputError, require_at_least, require_between

STORED_BYTES = 2
"""Bytes of a stored coefficient (half precision)."""


@dataclass(frozen=True)
class BlendShapeConfig:
    """Sizes of the blend shapes. The defaults are the paper's.

    Attributes:
        head_shapes: n_h, number of the head's shapes.
        body_shapes: n_b, number of the body's shapes.
        expression_size: number of expression parameters that drive the head.
        jaw: the jaw's rotation (axis-angle) drives the head too.
        pose_size: length of theta, which drives the body.
        width: of the layers of both mapping networks.
        hidden_layers: number of them.
        gated: head shapes act on the head alone and body shapes on the rest, by a weight for each Gaussian.
        parts: 1, every Gaussian has the same coefficients; more, every part of the Gaussians has its own.
    """

    head_shapes: int = 8
    body_shapes: int = 20
    expression_size: int = 10
    jaw: bool = False
    pose_size: int = 63
    width: int = 64
    hidden_layers: int = 2
    gated: bool = False
    parts: int = 1

    def __post_init__(self) -> None:
        for name in ("head_shapes", "body_shapes", "expression_size", "pose_size", "width", "parts"):
            require_at_least(f"blend shapes {name}", getattr(self, name), 1)
        require_between("blend shapes hidden_layers", self.hidden_layers, 1, MOST_LAYERS)

    @property
    def shapes(self) -> int:
        """Number of all shapes, n = n_h + n_b."""
        return self.head_shapes + self.body_shapes

    @property
    def head_inputs(self) -> int:
        """Length of the head's drivers: expression and jaw."""
        return self.expression_size + 3 * self.jaw


def mapping_networks(config: BlendShapeConfig) -> dict[str, nn.Module]:
    """Make the networks H, "head", and B, "body"."""
    return {
        "head": _mapping_network(config.head_inputs, config.parts * config.head_shapes, config),
        "body": _mapping_network(config.pose_size, config.parts * config.body_shapes, config),
    }


def _mapping_network(inputs: int, outputs: int, config: BlendShapeConfig) -> nn.Sequential:
    # inputs -> width -> ... -> width with ReLU, then a linear layer without activation: coefficients have any sign.
    sizes = [inputs, *[config.width] * config.hidden_layers]
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


class BlendShapes(nn.Module):
    """`du_i = U_i z`, `dc_i = C_i z`, `z = H(expression, jaw) + B(theta)` (+ joins vectors), for N Gaussians.

    U and C are (3, n) for every Gaussian and start at zero. With several parts z is that of the Gaussian's part. With
    gating, the first n_h columns are weighted by the head weight w_i and the others by 1 - w_i. Pruned blend shapes
    hold U and C of the `active` Gaussians only; the others have no residual.

    Args:
        config: sizes.
        count: N.
        part: below `config.parts`; needed where there are several.
        head_weight: in [0, 1]; needed with gating.
        active: increasing indices of the Gaussians that have blend shapes; None: all.

    Raises:
        InputError: one of these that does not fit the others.
    """

    active: Tensor
    part: Tensor | None
    head_weight: Tensor | None

    def __init__(
        self,
        config: BlendShapeConfig,
        count: int,
        *,
        part: Int[Tensor, " N"] | None = None,
        head_weight: Float[Tensor, " N"] | None = None,
        active: Int64[Tensor, " M"] | None = None,
    ) -> None:
        super().__init__()
        # Check the arguments against the configuration and each other.
        if (part is not None) != (config.parts > 1):
            raise InputError(
                "parts of the Gaussians",
                expected="given if and only if there are several",
                received=f"{config.parts} in the configuration, {'none' if part is None else 'some'} given",
            )
        if (head_weight is not None) != config.gated:
            raise InputError(
                "head weights",
                expected="given if and only if the blend shapes are gated",
                received=f"gated: {config.gated}, {'none' if head_weight is None else 'some'} given",
            )
        for name, value, largest in (("part", part, config.parts - 1), ("head weight", head_weight, 1)):
            if value is not None and (value.shape != (count,) or not bool(((value >= 0) & (value <= largest)).all())):
                raise InputError(
                    f"{name} of the Gaussians",
                    expected=f"{count} values from 0 to {largest}",
                    received=f"shape {tuple(value.shape)}, {float(value.min()):g} to {float(value.max()):g}",
                )
        if active is None:
            active = torch.arange(count)
        elif active.ndim != 1 or bool((active.diff() <= 0).any()) or bool(((active < 0) | (active >= count)).any()):
            raise InputError(
                "active Gaussians", expected=f"increasing indices below {count}", received=f"{active.tolist()[:8]} ..."
            )
        # Mapping networks, and bases that start at zero.
        self.config, self.count = config, count
        networks = mapping_networks(config)
        self.head, self.body = networks["head"], networks["body"]
        self.U = nn.Parameter(torch.zeros(len(active), 3, config.shapes))
        self.C = nn.Parameter(torch.zeros(len(active), 3, config.shapes))
        self.register_buffer("active", active)
        self.register_buffer("part", part)
        self.register_buffer("head_weight", head_weight)

    def coefficients(
        self,
        expression: Float[Tensor, "B E"],
        pose: Float[Tensor, "B T"],
        jaw: Float[Tensor, "B 3"] | None = None,
    ) -> Float[Tensor, "B P n"]:
        """Return z of every one of P parts.

        Args:
            expression: as many parameters as `expression_size`.
            pose: theta, radians, of length `pose_size`.
            jaw: axis-angle, radians; given if and only if the configuration says so.

        Raises:
            InputError: parameters of another size, a jaw too many or too few.
        """
        if (jaw is not None) != self.config.jaw:
            raise InputError(
                "jaw rotation", expected="one" if self.config.jaw else "none", received="none" if jaw is None else "one"
            )
        of_head = expression if jaw is None else torch.cat([expression, jaw], dim=-1)
        for name, value, size in (("head", of_head, self.config.head_inputs), ("body", pose, self.config.pose_size)):
            if value.ndim != 2 or value.shape[1] != size:
                raise InputError(
                    f"parameters of the {name}", expected=f"shape (B, {size})", received=f"shape {tuple(value.shape)}"
                )
        # (B, P, n_h) from H and (B, P, n_b) from B, side by side: the first n_h columns of z are the head's.
        parts = (self.config.parts, -1)
        return torch.cat([self.head(of_head).unflatten(1, parts), self.body(pose).unflatten(1, parts)], dim=-1)

    def forward(self, coefficients: Float[Tensor, "B P n"]) -> tuple[Float[Tensor, "B N 3"], Float[Tensor, "B N 3"]]:
        """Return du, metres in the triangles' frames, and dc, colour, of all Gaussians."""
        return self._blend(self.U, coefficients), self._blend(self.C, coefficients)

    def _blend(self, basis: Tensor, z: Tensor) -> Tensor:
        # Coefficients of each Gaussian's part, or one set for all, gated by the head's weight.
        B, M = len(z), len(basis)
        # Parts: gather z by part, (B, M, n), and contract with the basis (M, 3, n).
        if self.part is not None:
            of_gaussian = z[:, self.part[self.active]]
            if self.head_weight is not None:
                of_gaussian = of_gaussian * self._gate(self.head_weight)
            out = torch.einsum("mck,bmk->bmc", basis, of_gaussian)
        elif self.head_weight is not None:
            # Blend head and body shapes separately in one product, and weight the results.
            head = torch.arange(self.config.shapes, device=z.device) < self.config.head_shapes
            both = torch.where(torch.stack([head, ~head])[:, None], z[:, 0], 0.0)
            of_head, of_body = self._product(basis, both.flatten(0, 1)).unflatten(0, (2, B))
            w = self.head_weight[self.active][:, None]
            out = w * of_head + (1 - w) * of_body
        else:
            # One set of coefficients and no gate: a plain matrix product.
            out = self._product(basis, z[:, 0])
        if M == self.count:
            return out
        # Pruned Gaussians have no row in the basis and residual 0.
        return out.new_zeros(B, self.count, 3).index_copy(1, self.active, out)

    @staticmethod
    def _product(basis: Float[Tensor, "M 3 n"], z: Float[Tensor, "B n"]) -> Float[Tensor, "B M 3"]:
        # (B, n) times (n, 3 M): one matrix product is much faster than a batch of small ones.
        return (z @ basis.flatten(0, 1).T).unflatten(1, (-1, 3))

    def _gate(self, head_weight: Tensor) -> Tensor:
        """Return the factors (M, n) on the active Gaussians' shapes: w for the head's, 1 - w for the body's."""
        w = head_weight[self.active][:, None]
        return torch.cat([w.expand(-1, self.config.head_shapes), (1 - w).expand(-1, self.config.body_shapes)], dim=1)

    def stored_bytes(self) -> int:
        """Count the bytes of U, C and the mapping networks in half precision (and of `active`, if pruned)."""
        values = sum(parameter.numel() for parameter in self.parameters())
        return STORED_BYTES * values + (4 * len(self.active) if len(self.active) < self.count else 0)

    def importance(self, coefficient_std: Float[Tensor, "P n"]) -> Float[Tensor, " N"]:
        """Return each Gaussian's share of the variance of all in position and colour; 0 without blend shapes.

        The variance of a Gaussian's residual is `sum_k (|U_k| sigma_k)^2`, in position and in colour; each is divided
        by its sum over the Gaussians, so that both have equal weight.

        Args:
            coefficient_std: standard deviations of the coefficients over the training frames.
        """
        # (M, n) deviations of the coefficients that reach each Gaussian, gated as in `_blend`.
        sigma = coefficient_std[self.part[self.active]] if self.part is not None else coefficient_std
        if self.head_weight is not None:
            sigma = sigma * self._gate(self.head_weight)
        # Mean of the two shares, each with sum 1; the clamp leaves 0 where a basis is still zero everywhere.
        shares = torch.zeros(self.count, dtype=self.U.dtype, device=self.U.device)
        for basis in (self.U.detach(), self.C.detach()):
            energy = (basis * sigma[:, None]).square().sum((1, 2))
            shares[self.active] += 0.5 * energy / energy.sum().clamp_min(torch.finfo(energy.dtype).tiny)
        return shares

    def pruned(self, coefficient_std: Float[Tensor, "P n"], *, keep: float) -> BlendShapes:
        """Return a copy with the blend shapes of the most important Gaussians alone.

        Args:
            coefficient_std: see `importance`.
            keep: share of the N Gaussians that keep theirs, above 0 and at most 1.

        Raises:
            InputError: a share outside that range.
        """
        if not 0.0 < keep <= 1.0:
            raise InputError("share of blend shapes to keep", expected="above 0, at most 1", received=f"{keep:g}")
        # Keep the most important Gaussians, in the order of their indices.
        importance = self.importance(coefficient_std)[self.active]
        kept = torch.argsort(importance, descending=True, stable=True)[: max(1, round(keep * self.count))].sort().values
        small = BlendShapes(
            self.config, self.count, part=self.part, head_weight=self.head_weight, active=self.active[kept]
        ).to(self.U.device, self.U.dtype)
        small.head.load_state_dict(self.head.state_dict())
        small.body.load_state_dict(self.body.state_dict())
        with torch.no_grad():
            small.U.copy_(self.U[kept])
            small.C.copy_(self.C[kept])
        return small
