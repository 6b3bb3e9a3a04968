"""The projection network's parts: eigenvectors, kernel, invariants; bias and variance of a step that has learned nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from known_clouds import ball, cloud, model, rotation
from pcdenoise.cloud.neighbours import knn, spatial_order
from pcdenoise.denoising import pyramid
from pcdenoise.denoising.network_pass import trust
from pcdenoise.networks import exchange as exchanging
from pcdenoise.networks.exchange import Pooled, exchange
from pcdenoise.networks.projection import (
    Edges,
    Planes,
    ProjectionConfig,
    ProjectionNetwork,
    Stage,
    edge_features,
    edges,
    planes,
    point_features,
    smallest_eigenvector,
)

K = 24
NOISE = torch.tensor(0.05)


def graph_of(points: np.ndarray, k: int = K, count: Tensor | None = None) -> Edges:
    """Every point looks at its k nearest, in float64 so that only the formulas' own error is left."""
    index = torch.from_numpy(knn(points, k, threads=1)[1])
    sources = torch.from_numpy(points)
    return edges(sources[index] - sources[:, None], index, count)


def planes_of(normals: np.ndarray, graph: Edges) -> Planes:
    """Planes with given normals and the shapes that the neighbourhoods really have."""
    return Planes(torch.from_numpy(normals), planes(graph).shape)


def step_of(stage: Stage, graph: Edges, own: Planes) -> np.ndarray:
    """(N, 3) the displacement after all rounds of one stage among the points themselves."""
    with torch.no_grad():
        features = stage.embed(point_features(graph, own, NOISE).float())
        edge, a, b = edge_features(graph, own, own, NOISE)
        small = Edges(graph.offset.float(), graph.source, graph.weight.float(), graph.scale.float())
        for layer in stage.rounds:
            known, features = layer(edge.float(), small, features, layer.hear(features), stage.step.head)
        return stage.step(known, graph, own, own, a, b).numpy()


def stage_of(kind: str) -> Stage:
    stage = model(kind).network.stages[0]
    assert isinstance(stage, Stage)
    return stage


# Messages


class Drawn:
    """Random arguments of `exchange` and what plain layers make of them."""

    def __init__(self, m: int, n: int, k: int, c: int, dtype: torch.dtype) -> None:
        generator = torch.Generator().manual_seed(1)

        def drawn(*shape: int) -> Tensor:
            return torch.randn(*shape, generator=generator, dtype=dtype).requires_grad_()

        self.edge, self.own, self.heard = drawn(m, k, 8), drawn(m, c), drawn(n, c)
        self.layers = (drawn(c, 8), drawn(c)), (drawn(c, c), drawn(c)), (drawn(3, c), drawn(3))
        self.inputs = (self.edge, self.own, self.heard, *(part for layer in self.layers for part in layer))
        self.source = torch.randint(n, (m, k), generator=generator, dtype=torch.int32)
        weight = torch.rand(m, k, generator=generator, dtype=dtype)
        self.weight = weight / weight.sum(1, keepdim=True)
        self.pulls = [drawn(m, c).detach(), drawn(m, c).detach(), drawn(3, m, k).detach()]

    def plain(self) -> tuple[Tensor, ...]:
        (w1, b1), (w2, b2), (head, bias) = self.layers
        hidden = (self.edge @ w1.T + b1 + self.own[:, None] + self.heard[self.source]).relu()
        message = (hidden @ w2.T + b2).relu()
        most = (message * (self.weight / self.weight.amax(1, keepdim=True))[:, :, None]).amax(1)
        return (self.weight[:, :, None] * message).sum(1), most, (message @ head.T + bias).permute(2, 0, 1)

    def exchanged(self, has_head: bool = True) -> Pooled:
        first, second, head = self.layers
        return exchange(self.edge, self.own, self.heard, self.source, self.weight, first, second, head if has_head else None)

    def gradients(self, out: tuple[Tensor | None, ...], used: tuple[int, ...]) -> tuple[Tensor, ...]:
        loss = sum((self.pulls[i] * out[i]).sum() for i in used)
        return torch.autograd.grad(loss, self.inputs, retain_graph=True, materialize_grads=True)


USED = [(0, 1, 2), (2,), (0, 1)]


def test_messages_and_their_derivative_are_those_of_plain_layers() -> None:
    """More points than one part holds; float64, so that only the order of sums differs."""
    drawn = Drawn(300, 50, 5, 6, torch.float64)
    plain = drawn.plain()
    for one, other in zip(drawn.exchanged(), plain, strict=True):
        torch.testing.assert_close(one, other)
    for used in USED:
        for one, other in zip(drawn.gradients(drawn.exchanged(2 in used), used), drawn.gradients(plain, used), strict=True):
            torch.testing.assert_close(one, other)


@pytest.mark.skipif(not exchanging.IS_BUILT, reason="was installed where no C compiler is")
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(("c", "k"), [(32, 32), (48, 31), (32, 1), (48, 64)])
def test_compiled_messages_and_their_derivative_are_those_of_plain_layers(c: int, k: int, threads: int) -> None:
    """float32: sums of thousands of numbers of size one are off by some 1e-5 of the largest. Where what is cut at zero is so near
    it that rounding decides, a derivative may differ by its whole size, at fewer than one number in ten thousand."""
    drawn, before = Drawn(300, 50, k, c, torch.float32), torch.get_num_threads()
    plain = drawn.plain()
    torch.set_num_threads(threads)
    try:
        for used in USED:
            assert exchanging._is_compiled(drawn.edge, drawn.own)
            found = drawn.exchanged(2 in used)
            pairs = [(found[i], plain[i]) for i in used]
            pairs += zip(drawn.gradients(found, used), drawn.gradients(plain, used), strict=True)
            for one, other in pairs:
                assert one.shape == other.shape
                off = (one - other).abs() > 1e-4 * other.abs().max()
                assert off.double().mean() <= 1e-4
    finally:
        torch.set_num_threads(before)


def test_wider_messages_change_nothing_before_they_learn_and_hear_the_gradient() -> None:
    narrow = ProjectionNetwork(ProjectionConfig(channels=8, rounds=(2,), landing_rounds=1))
    wide = ProjectionNetwork(ProjectionConfig(channels=8, rounds=(2,), landing_rounds=1, messages=12))
    with torch.no_grad():
        for weights in narrow.parameters():
            weights += 0.1 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(2))
    wide.take(narrow)
    noisy = cloud("torus", 800, 1.0)
    points = noisy.noisy[spatial_order(noisy.noisy)]
    level = 0.5 * noisy.spacing
    found = [pyramid.descend(network, points, None, None, level, threads=1).last for network in (narrow, wide)]
    assert (found[0] - found[1]).abs().max() < 1e-6 * noisy.spacing
    found[1].square().sum().backward()
    assert wide.among[0].step.head.weight.grad[:, 8:].abs().max() > 0


# Eigenvectors


def symmetric(eigenvalues: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(M, 3, 3) with the given eigenvalues (M, 3) in random frames."""
    frames = np.linalg.qr(rng.standard_normal((len(eigenvalues), 3, 3)))[0]
    return (frames * eigenvalues[:, None]) @ frames.transpose(0, 2, 1)


SPECTRA = {
    "any": [0.0, 0.0, 0.0],
    "sheet": [0.0, 1.0, 1.0],
    "wire": [0.0, 0.0, 1.0],
    "almost a wire": [0.0, 1e-9, 1.0],
    "ball": [1.0, 1.0, 1.0],
    "almost a ball": [1.0, 1.0 + 1e-9, 1.0 + 2e-9],
    "two almost equal": [1.0, 1.0 + 1e-9, 2.0],
}


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("name", SPECTRA)
def test_the_closed_form_is_the_smallest_eigenvector_of_any_covariance(rng: np.random.Generator, name: str, unit: float) -> None:
    spectrum = np.tile(SPECTRA[name], (500, 1)) if name != "any" else np.sort(rng.random((500, 3)), axis=1)
    matrices = symmetric(spectrum * unit, rng)
    values, vectors = (found.numpy() for found in smallest_eigenvector(torch.from_numpy(matrices)))
    expected = np.linalg.eigvalsh(matrices)
    # The angle of the cubic's solution is an arc cosine: where two eigenvalues meet, it has half of float64's digits.
    np.testing.assert_allclose(values, expected, atol=4 * np.sqrt(np.finfo(float).eps) * unit)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-12)
    residual = (matrices @ vectors[:, :, None])[:, :, 0] - expected[:, :1] * vectors
    # A direction is lost at cross products of 1e-12, so what is kept has at least eps / 1e-12 = 2e-4, and 1e-7 if spread.
    tolerance = 2e-4 if name == "almost a wire" else 1e-7
    assert np.abs(residual).max() < tolerance * unit


def test_the_closed_form_agrees_with_a_general_solver_where_the_vector_is_unique(rng: np.random.Generator) -> None:
    spectrum = np.sort(rng.random((500, 3)), axis=1) + [0.0, 0.5, 0.5]
    matrices = symmetric(spectrum, rng)
    found = smallest_eigenvector(torch.from_numpy(matrices))[1].numpy()
    along = np.abs((found * np.linalg.eigh(matrices)[1][:, :, 0]).sum(axis=1))
    np.testing.assert_allclose(along, 1, atol=1e-12)


def test_points_on_an_axis_get_a_normal_across_it_and_no_spread_gets_any() -> None:
    # Exactly one large eigenvalue leaves no cross product of two rows to take.
    for axis in range(3):
        vector = smallest_eigenvector(torch.diag(torch.eye(3, dtype=torch.float64)[axis])[None])[1][0]
        assert vector[axis] == 0
        assert vector.norm() == pytest.approx(1)
    values, vectors = smallest_eigenvector(torch.zeros((1, 3, 3), dtype=torch.float64))
    assert vectors.norm() == pytest.approx(1)
    assert values.abs().max() < 1e-100


def test_planes_of_points_near_a_plane_are_that_plane_and_its_spread(rng: np.random.Generator) -> None:
    points = np.column_stack([rng.random((800, 2)), 1e-6 * rng.standard_normal(800)])
    turn = rotation(rng)
    graph = graph_of(points @ turn.T)
    found = planes(graph)
    cosine = found.normal.numpy() @ turn[:, 2]
    assert np.abs(np.abs(cosine) - 1).max() < 1e-7
    # √Σ w d² along the thin axis is the noise, up to its own scatter in 24 weighted points.
    assert float(found.shape[:, 0].median()) == pytest.approx(1e-6, rel=0.15)


# Kernel


def test_weights_sum_to_one_and_fall_smoothly_to_zero_at_the_last_neighbour(rng: np.random.Generator) -> None:
    graph = graph_of(rng.standard_normal((300, 3)))
    np.testing.assert_allclose(graph.weight.sum(dim=1), 1, atol=1e-12)
    assert (torch.diff(graph.weight, dim=1) <= 1e-15).all()
    assert graph.weight[:, -1].max() < 1e-20  # the square of what rounding leaves of zero
    # Both the kernel and its slope vanish there: a neighbour a share e before the end weighs of order e².
    offset = torch.tensor([[[0.0, 0, 0], [1 - 1e-4, 0, 0], [1, 0, 0]]], dtype=torch.float64)
    assert edges(offset, torch.zeros((1, 3), dtype=torch.int64), None).weight[0, 1] < 1e-6


def test_a_source_that_stands_for_n_points_weighs_n_times_as_much(rng: np.random.Generator) -> None:
    points = rng.standard_normal((200, 3))
    count = torch.from_numpy(rng.integers(1, 9, 200).astype(float))
    plain, counted = graph_of(points), graph_of(points, count=count)
    expected = plain.weight * count[plain.source]
    np.testing.assert_allclose(counted.weight, expected / expected.sum(dim=1, keepdim=True), atol=1e-12)


def test_offsets_and_weights_know_no_unit(rng: np.random.Generator) -> None:
    points = rng.standard_normal((200, 3))
    for factor in (1e-3, 1e3):
        one, other = graph_of(points), graph_of(points * factor)
        np.testing.assert_allclose(other.offset, one.offset, atol=1e-12)
        np.testing.assert_allclose(other.weight, one.weight, atol=1e-12)
        np.testing.assert_allclose(other.scale, one.scale * factor, rtol=1e-12)


def test_coincident_points_give_numbers() -> None:
    graph = graph_of(np.zeros((30, 3)))
    own = planes(graph)
    for values in (graph.weight, graph.offset, own.normal, own.shape, edge_features(graph, own, own, torch.tensor(0.0))[0]):
        assert torch.isfinite(values).all()


# Invariance


@pytest.mark.parametrize("change", ["turned", "mirrored", "flipped"])
def test_features_do_not_see_rotations_mirrors_and_the_signs_of_normals(rng: np.random.Generator, change: str) -> None:
    points = cloud("torus", 400, 0.3).noisy
    normals = rng.standard_normal((400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    turn = {"turned": rotation(rng), "mirrored": -rotation(rng), "flipped": np.eye(3)}[change]
    signs = rng.choice([-1.0, 1.0], (400, 1)) if change == "flipped" else np.ones((400, 1))
    one, other = graph_of(points), graph_of(points @ turn.T)
    np.testing.assert_array_equal(one.source, other.source)
    before, after = planes_of(normals, one), planes_of(normals * signs @ turn.T, other)
    np.testing.assert_allclose(
        edge_features(other, after, after, NOISE)[0], edge_features(one, before, before, NOISE)[0], atol=1e-12
    )
    np.testing.assert_allclose(point_features(other, after, NOISE), point_features(one, before, NOISE), atol=1e-6)


@pytest.mark.parametrize("change", ["turned", "mirrored", "flipped"])
def test_the_step_turns_with_the_cloud_and_does_not_see_the_signs_of_normals(rng: np.random.Generator, change: str) -> None:
    points = cloud("torus", 400, 0.3).noisy
    turn = {"turned": rotation(rng), "mirrored": -rotation(rng), "flipped": np.eye(3)}[change]
    signs = rng.choice([-1.0, 1.0], (400, 1)) if change == "flipped" else np.ones((400, 1))
    one, other = graph_of(points), graph_of(points @ turn.T)
    normals = planes(one).normal.numpy()
    before = step_of(stage_of("seeded"), one, planes_of(normals, one))
    after = step_of(stage_of("seeded"), other, planes_of(normals * signs @ turn.T, other))
    np.testing.assert_allclose(after, before @ turn.T, atol=1e-5)  # the messages are float32
    assert np.abs(before).max() > 1e-2


def test_features_tell_a_neighbour_above_from_one_beside() -> None:
    offset = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [0, 0, 1], [1.5, 0, 0]]], dtype=torch.float64)
    graph = edges(offset, torch.tensor([[0, 1, 2, 3]]), None)
    up = Planes(torch.tensor([[0.0, 0, 1]], dtype=torch.float64), torch.ones((1, 3), dtype=torch.float64))
    theirs = Planes(up.normal.expand(4, 3), up.shape.expand(4, 3))
    features, a, b = edge_features(graph, up, theirs, NOISE)
    assert a[0].tolist() == b[0].tolist() == [0, 0, pytest.approx(1 / float(graph.scale)), 0]
    assert not torch.allclose(features[0, 1], features[0, 2])


# Trust


def trusted_of(planes: Planes, noise: float) -> np.ndarray:
    return trust(planes.shape.numpy(), noise)


def test_points_of_a_noisy_surface_are_trusted_whatever_its_noise() -> None:
    for name in ("sphere", "torus", "cube"):
        for std_spacings in (0.1, 0.5, 1.0):
            noisy = cloud(name, 2000, std_spacings)
            trusted = trusted_of(planes(graph_of(noisy.noisy)), std_spacings * noisy.spacing)
            assert (trusted > 0.9).mean() > 0.9


def test_points_of_a_flat_surface_are_trusted_even_if_its_noise_is_not_known() -> None:
    noisy = cloud("plane", 2000, 0.2)
    trusted = trusted_of(planes(graph_of(noisy.noisy)), 1e-9)
    assert (trusted > 0.9).mean() > 0.9
    assert trusted_of(planes(graph_of(noisy.clean)), 0.0).tolist() == [1.0] * 2000


def test_points_of_wires_and_volumes_thicker_than_the_noise_are_not_trusted(rng: np.random.Generator) -> None:
    wire = np.outer(rng.random(1000), [1.0, 1.0, 0.0]) + 0.01 * rng.standard_normal((1000, 3))
    for points, noise in ((wire, 0.002), (ball(2000, rng), 0.01)):
        trusted = trusted_of(planes(graph_of(points)), noise)
        assert np.median(trusted) < 0.5
        assert trusted.min() == 0
        turned = trusted_of(planes(graph_of(points @ rotation(rng).T * 100)), 100 * noise)
        np.testing.assert_allclose(turned, trusted, atol=1e-6)


# Bias and variance of the untrained step


def test_on_a_plane_the_step_is_the_kernel_mean_of_heights_whose_variance_is_the_squared_weights(
    rng: np.random.Generator,
) -> None:
    # All normals along z: a = b = z_j - z_i and the halves add up to z_i' = Σ w z_j, whose variance is σ² Σ w².
    n, std = 20_000, 1e-4
    points = np.column_stack([10 * rng.random((n, 2)), np.zeros(n)])
    graph = graph_of(points)
    points[:, 2] = std * rng.standard_normal(n)
    offset = graph.offset.clone()
    heights = torch.from_numpy(points[:, 2])
    offset[:, :, 2] = (heights[graph.source] - heights[:, None]) / graph.scale
    noisy = graph._replace(offset=offset)
    up = Planes(torch.tensor([[0.0, 0, 1]], dtype=torch.float64).expand(n, 3), planes(graph).shape)
    moved = points + step_of(stage_of("untrained"), noisy, up)
    np.testing.assert_allclose(moved[:, 2], (graph.weight * heights[graph.source]).sum(dim=1), atol=1e-12)
    np.testing.assert_array_equal(moved[:, :2], points[:, :2])
    # n / 24 independent neighbourhoods: the measured variance scatters by √(2 · 24 / n) = 5 %.
    remains = float((graph.weight**2).sum(dim=1).mean())
    assert (moved[:, 2] ** 2).mean() / std**2 == pytest.approx(remains, rel=0.15)
    assert remains < 0.15


def test_on_a_sphere_with_true_normals_the_drift_is_of_fourth_order(rng: np.random.Generator) -> None:
    # a = -R(1 - cos θ) and b = +R(1 - cos θ), so along the normal Δ = -R/2 Σ w (1 - cos θ)²; kernel means sink R Σ w (1 - cos θ).
    normals = cloud("sphere", 3000, 0.0).clean
    radius = 5.0
    graph = graph_of(radius * normals)
    step = step_of(stage_of("untrained"), graph, planes_of(normals, graph))
    cosine = torch.from_numpy(normals)[graph.source] @ torch.from_numpy(normals)[:, :, None]
    sagitta = 1 - cosine[:, :, 0]
    radial = (step * normals).sum(axis=1)
    np.testing.assert_allclose(radial, -radius / 2 * (graph.weight * sagitta**2).sum(dim=1), atol=1e-12)
    by_mean = radius * float((graph.weight * sagitta).sum(dim=1).mean())
    assert np.abs(radial).mean() < by_mean * 24 / 3000  # the cap of 24 of 3000 points has sagittas up to 2 · 24 / 3000


@pytest.mark.parametrize("curvatures", [(1.0, 1.0), (1.0, -1.0), (1.0, 0.0)])
def test_on_a_quadric_with_true_normals_curvature_cancels_to_second_order(curvatures: tuple[float, float]) -> None:
    k = np.array(curvatures)

    def drift(reach: float) -> float:
        turns = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
        xy = reach * np.concatenate([[[0.0, 0.0]], 0.3 * ring, 0.6 * ring, ring])
        points = np.column_stack([xy, 0.5 * (xy**2 @ k)])
        normals = np.column_stack([-xy * k, np.ones(len(xy))])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        order = np.argsort(np.linalg.norm(points, axis=1), kind="stable")
        points, normals = points[order], normals[order]
        index = torch.arange(len(points))[None]
        graph = edges(torch.from_numpy(points)[None], index, None)
        own = Planes(torch.from_numpy(normals[:1]), torch.ones((1, 3), dtype=torch.float64))
        theirs = Planes(torch.from_numpy(normals), torch.ones((len(points), 3), dtype=torch.float64))
        stage = stage_of("untrained")
        _, a, b = edge_features(graph, own, theirs, NOISE)
        with torch.no_grad():
            move = stage.step(torch.zeros((3, 1, len(points))), graph, own, theirs, a, b)[0]
        assert move[:2].abs().max() < 1e-12  # the neighbourhood is symmetric
        return float(move[2].abs())

    # z (1 - 1 / (1 + |∇z|²)) / 2 is a term of fourth order in the reach: half the reach leaves a sixteenth. Where the two
    # curvatures are opposite, the heights around a ring cancel and so must the step.
    if sum(curvatures) == 0:
        assert drift(0.1) < 1e-12
    else:
        assert 0 < drift(0.1) < 0.25 * 0.1**4
        assert drift(0.2) / drift(0.1) == pytest.approx(16, rel=0.1)


def test_learned_weights_change_the_step_and_unlearned_ones_do_not() -> None:
    points = cloud("sphere", 300, 0.3).noisy
    graph = graph_of(points)
    own = planes(graph)
    torch.manual_seed(5)
    other = Stage(32, 32, 2)
    untrained = step_of(stage_of("untrained"), graph, own)
    np.testing.assert_allclose(step_of(other, graph, own), untrained, atol=1e-12)
    assert np.abs(step_of(stage_of("seeded"), graph, own) - untrained).max() > 1e-3
