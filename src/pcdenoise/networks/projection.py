"""The projection network: every point steps onto the surface that its neighbours' tangent planes agree on.

Here: the network and the tensors it is fed with. Not here: neighbour search, coarse-to-fine order, blocks (denoising),
losses and training (learning).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from pcdenoise.networks.exchange import exchange

N_EDGE_FEATURES = 8
N_POINT_FEATURES = 4
_KERNEL_SHARE = 0.7  # the kernel's unit of length as a share of the distance to the furthest neighbour


@dataclass(frozen=True)
class ProjectionConfig:
    """Sizes of the network: feature channels, neighbours per point, rounds of messages in each stage, channels of a message.

    messages: 0 stands for as many as features have.
    """

    channels: int = 32
    neighbours: int = 24
    rounds: tuple[int, ...] = (2, 2)
    landing_rounds: int = 1
    messages: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "messages", self.messages or self.channels)


class Edges(NamedTuple):
    """M points that look at K sources each; everything is relative to the point, in units of its `scale`.

    offset (M, K, 3) source minus point; source (M, K) their rows; weight (M, K) kernel times the number of raw points
    behind a source, zero at the furthest neighbour and of sum one; scale (M, 1) length unit in local units.
    """

    offset: Tensor
    source: Tensor
    weight: Tensor
    scale: Tensor


class Planes(NamedTuple):
    """Tangent planes of M points: normal (M, 3), of either sign; shape (M, 3): standard deviations along the axes."""

    normal: Tensor
    shape: Tensor

    def block(self, rows: slice) -> Planes:
        """The planes of some rows."""
        return Planes(self.normal[rows], self.shape[rows])


def edges(offset: Tensor, index: Tensor, count: Tensor | None) -> Edges:
    """Kernel weights. offset (M, K, 3) in any unit, count (N,) raw points per source or None.

    The kernel falls to zero at the furthest neighbour, so that nothing jumps when a point enters or leaves the neighbourhood.
    """
    with torch.no_grad():
        squared = offset.square().sum(-1)
        scale = _KERNEL_SHARE * squared.amax(-1, keepdim=True).sqrt().clamp_min(1e-12)
        squared = squared / scale.square()
        weight = torch.exp(-squared) * (1 - _KERNEL_SHARE**2 * squared).clamp_min(0).square()
        if count is not None:
            weight = weight * count.index_select(0, index.reshape(-1)).view(index.shape)
        weight = weight / weight.sum(-1, keepdim=True).clamp_min(1e-12)
    return Edges(offset / scale[:, :, None], index, weight, scale)


def at(values: Tensor, index: Tensor) -> Tensor:
    """(M, K, C) rows of (N, C) values for (M, K) rows' numbers. Vectors come axis by axis in memory: sums over them are then
    sums of long rows, many times faster than of three neighbouring numbers."""
    flat = index.reshape(-1)
    if values.shape[1] > 3:
        return values.index_select(0, flat).view(*index.shape, -1)
    return torch.stack([axis.index_select(0, flat).view(index.shape) for axis in values.unbind(1)]).permute(1, 2, 0)


def planes(graph: Edges) -> Planes:
    """Weighted PCA of each neighbourhood, without gradient."""
    with torch.no_grad():
        offset, weight = graph.offset.double(), graph.weight.double()
        spread = [axis - (weight * axis).sum(-1, keepdim=True) for axis in offset.unbind(-1)]
        pulling = [weight * axis for axis in spread]
        entries = {(i, j): (pulling[i] * spread[j]).sum(-1) for i in range(3) for j in range(i, 3)}
        covariance = torch.stack([entries[min(i, j), max(i, j)] for i in range(3) for j in range(3)], dim=-1).view(-1, 3, 3)
        eigenvalues, normal = smallest_eigenvector(covariance)
        return Planes(normal.to(graph.offset), graph.scale * eigenvalues.clamp_min(0).sqrt().to(graph.offset))


def smallest_eigenvector(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Ascending eigenvalues (M, 3) and the unit eigenvector (M, 3) of the smallest, of symmetric (M, 3, 3) float64, closed form.

    Trigonometric solution of the characteristic cubic (Smith 1961); the vector is the longest cross product of two rows of
    (A - λI). Where two eigenvalues coincide any vector of their plane is right.
    """
    mean = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)
    identity = torch.eye(3, dtype=matrix.dtype)
    centred = matrix - mean[:, None, None] * identity
    size = (centred.square().sum((-2, -1)) / 6).sqrt().clamp_min(1e-150)
    unit = centred / size[:, None, None]
    angle = torch.acos((torch.linalg.det(unit) / 2).clamp(-1, 1)) / 3
    turns = angle[:, None] + torch.tensor([2 * torch.pi / 3, 4 * torch.pi / 3, 0.0], dtype=matrix.dtype)
    eigenvalues = mean[:, None] + 2 * size[:, None] * torch.cos(turns)
    rows = unit - 2 * torch.cos(turns[:, 0])[:, None, None] * identity
    crosses = torch.stack([torch.linalg.cross(rows[:, i], rows[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))], dim=1)
    length = crosses.norm(dim=-1)
    best = length.argmax(dim=1)
    row = torch.arange(len(matrix))
    vector = crosses[row, best] / length[row, best, None].clamp_min(1e-150)
    lost = length[row, best] < 1e-12  # all rows along the one large eigenvalue's vector: any direction across it will do
    along = rows[row, rows.norm(dim=-1).argmax(dim=1)][lost]
    across = torch.linalg.cross(along, identity[along.abs().argmin(dim=1)])
    vector[lost] = across / across.norm(dim=-1, keepdim=True)
    return eigenvalues, vector


def point_features(graph: Edges, plane: Planes, noise: Tensor) -> Tensor:
    """(M, 4) what a point knows of its surroundings: thickness, narrowness, noise in its scale, noise explaining thickness.

    noise (M,), or one for all: standard deviation, in the unit of `graph.scale`.
    """
    thin, middle, wide = (plane.shape / graph.scale).unbind(-1)
    level = noise / graph.scale[:, 0]
    return torch.stack([2 * thin, 2 * (wide - middle), 4 * level / (1 + level), thin / (thin + level + 1e-6)], dim=-1)


def edge_features(graph: Edges, own: Planes, theirs: Planes, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """(M, K, 8) invariants of each edge, and the signed heights a and b (M, K) that they are made of.

    noise (M,), or one for all: standard deviation. a: height of the neighbour over my plane; b: height of the neighbour's plane
    over me. All features keep their value when the cloud is rotated or mirrored and when any normal changes its sign.
    """
    normal = at(theirs.normal, graph.source)
    a = (graph.offset * own.normal[:, None]).sum(-1)
    b = (graph.offset * normal).sum(-1)
    cosine = (normal * own.normal[:, None]).sum(-1)
    level = (noise.reshape(-1, 1) / graph.scale + 0.02).expand_as(a)
    high, deep = a.abs(), b.abs()
    features = torch.stack(
        [
            graph.offset.square().sum(-1).clamp_min(1e-24).sqrt(),
            4 * high,
            4 * deep,
            cosine.square(),
            16 * a * b * cosine,
            high / (high + level),
            deep / (deep + level),
            4 * (graph.weight + 1e-4).sqrt(),
        ]
    )
    return features.permute(1, 2, 0), a, b


class MessageRound(nn.Module):
    """One exchange between points and their sources: m = MLP(e, h_i, h_j) on every edge, pooled into the points' features."""

    def __init__(self, channels: int, messages: int) -> None:
        super().__init__()
        self.edge = nn.Linear(N_EDGE_FEATURES, messages)
        self.own = nn.Linear(channels, messages, bias=False)
        self.their = nn.Linear(channels, messages, bias=False)
        self.message = nn.Linear(messages, messages)
        self.update = nn.Linear(2 * messages, channels)
        self.norm = nn.LayerNorm(channels)

    def hear(self, their: Tensor) -> Tensor:
        """(N, C) what all sources say, from their features (N, C); done once, not once per edge."""
        said: Tensor = self.their(their)
        return said

    def forward(
        self, features: Tensor, graph: Edges, own: Tensor, heard: Tensor, head: nn.Linear | None = None
    ) -> tuple[Tensor | None, Tensor]:
        """What a head makes of the messages (3, M, K), if there is one, and the points' new features (M, C).

        features (M, K, 8), own (M, C), heard (N, C).
        """
        first, second = ((layer.weight, layer.bias) for layer in (self.edge, self.message))
        last = None if head is None else (head.weight, head.bias)
        mean, most, known = exchange(features, self.own(own), heard, graph.source, graph.weight, first, second, last)
        return known, self.norm(own + self.update(torch.cat([mean, most], dim=-1)))


class Step(nn.Module):
    """Messages to a displacement: every neighbour's plane pulls along its normal, my own plane moves along mine.

        Δx_i = s·( Σ_j w (½+β) b n_j + n_i Σ_j w (½+α) a ),   w = softmax_j(log kernel + ω)

    On a quadric a ≈ -κt²/2 and b ≈ +κt²/2: the sum cancels curvature to second order with plane normals only, so nothing
    drifts inward. ω, β, α start at zero: an untrained network already is a good classical filter.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.head = nn.Linear(channels, 3)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, known: Tensor, graph: Edges, own: Planes, theirs: Planes, a: Tensor, b: Tensor) -> Tensor:
        """(M, 3) displacement in the unit of `graph.scale`'s lengths. known (3, M, K): ω, β and α of each edge, by the head."""
        sharpness, pull, lift = known
        weight = graph.weight * torch.exp(4 * torch.tanh(sharpness / 4))
        weight = weight / weight.sum(-1, keepdim=True).clamp_min(1e-12)
        pulled = ((weight * (0.5 + pull) * b)[:, :, None] * at(theirs.normal, graph.source)).sum(1)
        lifted = (weight * (0.5 + lift) * a).sum(-1, keepdim=True) * own.normal
        move: Tensor = graph.scale * (pulled + lifted)
        return move


class Stage(nn.Module):
    """Some rounds of messages, then one step."""

    def __init__(self, channels: int, messages: int, rounds: int) -> None:
        super().__init__()
        self.embed = nn.Linear(N_POINT_FEATURES, channels)
        self.rounds = nn.ModuleList(MessageRound(channels, messages) for _ in range(rounds))
        self.step = Step(messages)

    @property
    def exchanges(self) -> list[MessageRound]:
        """The rounds, in order."""
        return [layer for layer in self.rounds if isinstance(layer, MessageRound)]


class ProjectionNetwork(nn.Module):
    """Stages among the seeds, then one `landing` of all points on the seeds' surface. `denoising.pyramid` runs them."""

    def __init__(self, config: ProjectionConfig) -> None:
        super().__init__()
        self.config = config
        self.stages = nn.ModuleList(Stage(config.channels, config.messages, rounds) for rounds in config.rounds)
        self.landing = Stage(config.channels, config.messages, config.landing_rounds)

    @property
    def among(self) -> list[Stage]:
        """The stages in which seeds look at each other, in order."""
        return [stage for stage in self.stages if isinstance(stage, Stage)]

    def take(self, learned: ProjectionNetwork) -> None:
        """The weights of a network whose messages are no wider: channels that are more here are not heard as yet.

        So both do the same before anything is learned (net2net: Chen, Goodfellow and Shlens 2016).
        """
        theirs, extra = learned.state_dict(), self.config.messages - learned.config.messages
        with torch.no_grad():
            for name, own in self.state_dict().items():
                given = theirs[name]
                if name.endswith("update.weight"):  # hears means and maxima side by side
                    given = torch.cat([nn.functional.pad(part, (0, extra)) for part in given.chunk(2, dim=1)], dim=1)
                elif name.endswith(("message.weight", "head.weight")):
                    given = nn.functional.pad(given, (0, extra))
                own[tuple(slice(length) for length in given.shape)] = given
