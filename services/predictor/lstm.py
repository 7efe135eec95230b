"""The risk-aware LSTM: an encoder over X_1 … X_30 and a decoder to Z_1 … Z_60, in two forms of the same code.

`paper`: positions and surrounding risks go into the encoder LSTM; self-attention over its outputs gives the decoder a
context; the decoder LSTM feeds every Z_i back as its next input and writes 2-D positions.

`residual`: the encoder reads the deviation from constant velocity, the steps, the surrounding risks and the leader; one
query over the attended outputs, the last state and a context of class and speed give the coefficients of a smooth
residual to constant velocity at once, without feedback.

`risk` and `attention` are the paper's two ablations, `leader` one of ours; a switched-off input is not there at all.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn

from common.messages import PREDICTION_FRAMES
from services.predictor.features import BASIS, CONTEXT, POSITION_SCALE, basis
from services.predictor.leader import LEADER_SIGNALS
from services.predictor.surrounding_risk import RISK_POINTS

Form = Literal["paper", "residual"]


@dataclass(frozen=True)
class Architecture:
    """Everything that fixes the shapes of the weights."""

    form: Form = "residual"
    hidden: int = 64
    risk: bool = True
    attention: bool = True
    leader: bool = True

    @property
    def inputs(self) -> int:
        """Numbers in X_i."""
        leader = self.form == "residual" and self.leader
        return (2 if self.form == "paper" else 4) + RISK_POINTS * self.risk + LEADER_SIGNALS * leader

    def as_dict(self) -> dict[str, Any]:
        """For the model card."""
        return asdict(self)

    def chosen(self, x: Tensor) -> Tensor:
        """The columns of the full inputs that this architecture reads."""
        first = 2 if self.form == "paper" else 4
        parts = [x[..., :first]]
        if self.risk:
            parts.append(x[..., first : first + RISK_POINTS])
        if self.form == "residual" and self.leader:
            parts.append(x[..., first + RISK_POINTS :])
        return torch.cat(parts, dim=-1)


class SelfAttention(nn.Module):
    """softmax(Q Kᵀ / √d) V over the encoder's outputs, added to them."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.project = nn.Linear(width, 3 * width)
        self.scale = width**-0.5

    def forward(self, h: Tensor) -> Tensor:
        """Shape [n, 30, width] in and out."""
        q, k, v = self.project(h).chunk(3, dim=-1)
        weights = torch.softmax(q @ k.transpose(1, 2) * self.scale, dim=-1)
        attended: Tensor = h + weights @ v
        return attended


class Network(nn.Module):
    """Encoder, self-attention and the decoder of the chosen form."""

    basis: Tensor

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        width = architecture.hidden
        self.encoder = nn.LSTM(architecture.inputs, width, batch_first=True)
        self.attention = SelfAttention(width) if architecture.attention else None
        self.query = nn.Linear(width, width, bias=False) if architecture.attention else None
        seen = width * (2 if architecture.attention else 1)
        if architecture.form == "paper":
            self.decoder = nn.LSTMCell(2 + seen - width, width)
            self.head = nn.Linear(seen, 2)
        else:
            self.body = nn.Sequential(nn.Linear(seen + CONTEXT, width), nn.SiLU())
            self.head = nn.Linear(width, 2 * BASIS)
            nn.init.zeros_(self.head.weight)
            nn.init.zeros_(self.head.bias)
        self.register_buffer("basis", torch.from_numpy(basis()), persistent=False)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        """Own-frame positions (paper) or residual (residual) at the 60 frames [m], shape [n, 60, 2].

        Args:
            x: Full inputs of the form, oldest first, shape [n, 30, …].
            context: Shape [n, CONTEXT]; the paper form does not read it.
        """
        outputs, (h, c) = self.encoder(self.architecture.chosen(x))
        attended = outputs if self.attention is None else self.attention(outputs)
        if self.architecture.form == "paper":
            return self._decoded(attended, h[0], c[0])
        z = torch.cat((self._seen(attended, h[0]), context), dim=-1)
        return self.positions(self.head(self.body(z)))

    def positions(self, coefficients: Tensor) -> Tensor:
        """Positions from coefficients [n, 2 · BASIS]."""
        return (coefficients.view(-1, 2, BASIS) @ self.basis.T).transpose(1, 2)

    def _seen(self, attended: Tensor, state: Tensor) -> Tensor:
        """The state, and what a query with it finds in the attended outputs."""
        if self.query is None:
            return state
        weights = torch.softmax((attended @ self.query(state)[:, :, None])[..., 0] * state.shape[-1] ** -0.5, dim=-1)
        return torch.cat((state, (weights[:, None] @ attended)[:, 0]), dim=-1)

    def _decoded(self, attended: Tensor, h: Tensor, c: Tensor) -> Tensor:
        """Sixty steps, each from the one before."""
        width, z = h.shape[-1], h.new_zeros(len(h), 2)
        outputs = []
        for _ in range(PREDICTION_FRAMES):
            seen = self._seen(attended, h)
            h, c = self.decoder(torch.cat((z, seen[:, width:]), dim=-1), (h, c))
            z = z + self.head(torch.cat((h, seen[:, width:]), dim=-1))
            outputs.append(z)
        return torch.stack(outputs, dim=1) * POSITION_SCALE
