"""Networks that make images of frames: their model, training, files, and what an image by them says of itself."""

from __future__ import annotations

import itertools
import json
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

pytest.importorskip("torch", reason="torch is an extra: pip install 'mitsim[learn]'")

import torch

from mitsim import verbs
from mitsim.core.errors import ArgumentError, MitsimError
from mitsim.core.job import Job, Limits
from mitsim.core.runs import Capture
from mitsim.learn import networks
from mitsim.learn.networks import Data, Diagonal, LearnedSolver, Trained, UNet, train_network
from mitsim.learn.requests import METHODS, Training
from mitsim.metrics import psnr
from mitsim.reconstruct.reconstruct import Reconstruction, reconstruct
from mitsim.reconstruct.solvers import SOLVERS
from tests.ideal_sessions import Bench, bench, picture

DOUBLE = torch.zeros((), dtype=torch.float64)
STEPS = 40


class FakeStore:
    """``count`` pairs of pictures under ``patterns``."""

    def __init__(
        self, count: int = 24, patterns: str = "uniform", camera: Bench | None = None, photographs: int | None = None
    ) -> None:
        self.photographs = np.arange(count) % (photographs or count)
        runs = [(camera or bench()).run(patterns, picture(seed), seed) for seed in range(100, 100 + count)]
        self.folder, self.patterns = Path("pairs"), runs[0].patterns
        measured = [list(run.pattern_measurements()) for run in runs]
        self.indices = np.array([(each.row, each.column) for each in measured[0]])
        self._frames = [np.stack([each.frame for each in frames]).astype(np.float32) for frames in measured]
        self._truths = [np.asarray(run.truth, np.float32) for run in runs]
        about = {"count": count, "idealised": True}
        self.manifest: Any = SimpleNamespace(
            m=self._frames[0].shape[1:],
            frames=len(self.indices),
            patterns=patterns,
            exposure_s=runs[0].exposure_s,
            model_dump=lambda **_: about,
        )

    def __len__(self) -> int:
        return len(self._frames)

    def frames(self, index: int) -> np.ndarray:
        return self._frames[index]

    def truth(self, index: int) -> np.ndarray:
        return self._truths[index]


@pytest.fixture(autouse=True)
def _one_thread() -> Any:
    """Beside other test processes more threads of torch wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def trained(path: Path, method: str = "unrolled") -> Trained:
    return train_network(FakeStore(), bench().calibrated(1), Training(method=method, steps=STEPS, seed=3), path)


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    return trained(tmp_path_factory.mktemp("model") / "m.pt")


@pytest.fixture(scope="module")
def model(training: Trained) -> LearnedSolver:
    return training.model


def summed(solver: Any, patterns: str = "uniform") -> tuple[Any, Any]:
    """A picture's frames in the model of ``solver``: what is prepared, and the problem that they pose."""
    camera = bench()
    shots = camera.run(patterns, picture(1), 1)
    prepared = solver.init(camera.calibrated(1), shots.patterns)
    measured = ((each.frame, each.row, each.column) for each in shots.pattern_measurements())
    return prepared, prepared.accumulator(measured)


# -------- The network


def test_a_network_looks_at_images_in_eight_ways() -> None:
    """A network that sees corners alike sees each image eight ways, all other; one of a single kernel that is as
    symmetric as a square sees it one way. (Planted: turned back before it is mirrored back; half of the ways alike.)"""
    random = torch.Generator().manual_seed(4)
    network, images = UNet(1, 4).eval(), torch.randn((2, 1, 13, 18), generator=random)
    torch.nn.init.normal_(network.last.weight, generator=random)
    with torch.no_grad():
        seen = [network(images, way) for way in range(networks.WAYS)]
        assert all(each.shape == images.shape for each in seen)
        assert min(float((a - b).abs().max()) for n, a in enumerate(seen) for b in seen[:n]) > 1e-3
        for values in network.parameters():
            if values.ndim == 4:
                values.copy_(values.mean(dim=(-2, -1), keepdim=True).expand_as(values))
        for up, size in zip(network.up, (4, 8, 16), strict=True):
            for values in (up.weight, up.bias):  # four numbers for the four pixels of each
                four = values.reshape(size, 4, -1)
                values.copy_(four.mean(1, keepdim=True).expand_as(four).reshape(values.shape))
        square = images[..., :8, :8]
        for way in range(networks.WAYS):
            assert_allclose(network(square, way), network(square), atol=1e-5)


def test_half_precision_is_of_training_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """(Planted: of images too.)"""
    network, images = UNet(1, 4), torch.randn((1, 1, 16, 16), generator=torch.Generator().manual_seed(1))
    torch.nn.init.ones_(network.last.weight)
    monkeypatch.setattr(networks, "has_half", lambda device: False)
    single = network(images).detach()
    monkeypatch.setattr(networks, "has_half", lambda device: True)
    assert torch.equal(network.eval()(images), single)
    rounded = network.train()(images).detach()
    assert 1e-4 < float((rounded - single).abs().max() / single.abs().max()) < 0.1


def test_an_image_is_the_mean_over_all_ways(model: LearnedSolver) -> None:
    """And single precision makes it, whatever made the network. (Planted: seven of eight.)"""
    network = model.network
    prepared, sums = summed(model)
    problem, like = prepared.problem(sums), next(network.parameters())
    data = Data.of(problem.projected[None], networks.datum_variance(problem), like)
    diagonal = Diagonal.of(prepared, like)
    with torch.no_grad():
        each = [network(data, diagonal, way) for way in range(networks.WAYS)]
        assert_allclose(network.images(data, diagonal), torch.stack(each).mean(0), atol=1e-6)
    assert float((each[1] - each[6]).abs().max()) > 1e-6
    assert not network.training


def test_a_method_adds_the_change_of_its_networks(model: LearnedSolver) -> None:
    """Networks that return a constant brighten an image by it before each step of the frames, if these count for
    nothing. (Planted: the change taken off.)"""
    prepared, sums = summed(model)
    data = Data.of(prepared.problem(sums).projected[None], 1.0, DOUBLE)
    diagonal, network = Diagonal.of(prepared, DOUBLE), networks.Unrolled((16, 16)).double()
    with torch.no_grad():
        network.log_rho += 60
        for each in network.networks:
            each.last.bias.fill_(0.125)
        start = network.start(data, diagonal) + 0.5
        assert_allclose(network(data, diagonal), start + 3 * 0.125, rtol=1e-9)


# -------- The camera's model


def test_the_step_of_the_frames_is_the_closed_form() -> None:
    """Of a black start the solver's own image at that lambda, of another the least squares written out; a dot test.
    (Planted: rho beside sigma, not beside its square; the basis of columns not transposed.)"""
    prepared, sums = summed(SOLVERS["tikhonov"], "dots:3")
    problem, variance, lam = prepared.problem(sums), 7.0, 3e3
    data, own = Data.of(problem.projected[None], variance, DOUBLE), Diagonal.of(prepared, DOUBLE)
    rho = torch.tensor(lam / variance, dtype=torch.float64)
    found = own.nearest(data, torch.zeros(1, 1, 16, 16, dtype=torch.float64), rho)[0, 0]
    assert_allclose(found, prepared.solve(sums, lam).image, rtol=1e-9, atol=1e-12)
    start = np.random.default_rng(1).normal(size=(16, 16))
    matrix = np.kron(prepared.left.basis.T, prepared.right.basis.T) * prepared.sigma.reshape(-1, 1)
    stacked = np.vstack([matrix, np.sqrt(lam) * np.eye(256)])
    right = np.concatenate([problem.projected.ravel(), np.sqrt(lam) * start.ravel()])
    expected = np.linalg.lstsq(stacked, right, rcond=None)[0].reshape(16, 16)
    assert_allclose(own.nearest(data, torch.as_tensor(start)[None, None], rho)[0, 0], expected, rtol=1e-8, atol=1e-9)
    weights = torch.randn(own.sigma.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    there = (own.coefficients(torch.as_tensor(start)) * weights).sum()
    assert abs(there - (torch.as_tensor(start) * own.images(weights)).sum()) < 1e-12 * abs(there)


# -------- Training


@pytest.mark.parametrize("method", METHODS)
def test_every_method_learns(method: str, training: Trained, tmp_path: Path) -> None:
    """Of a few pairs, on pairs that did not teach, and on frames of one more. (Planted: truths of other pairs.)"""
    made = training if method == training.model.manifest.method else trained(tmp_path / "m.pt", method)
    assert made.curve[0][0] == 0 and max(value for _, value in made.curve) > made.curve[0][1] + 0.5
    blank = replace(made.model, network=networks.first_network(Training(method=method), (16, 16)))
    before, after = (psnr(image_of(each).image, picture(5)) for each in (blank, made.model))
    assert after > before + 0.3


def test_an_interrupted_training_goes_on_bit_equal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And one that was not interrupted twice the same. (Planted: weights without what the optimiser knows; progress by
    the steps squared; any precision taken for the same.)"""
    store, factors = FakeStore(12), bench().calibrated(1)
    request = Training(method="unrolled", steps=6, batch=4, seed=1)

    def weights(name: str, **more: Any) -> dict[str, np.ndarray]:
        made = train_network(store, factors, request, tmp_path / name, **more)
        assert not (tmp_path / f"{name}.unfinished").exists()
        state = networks.read_network(tmp_path / name, "cpu").network.state_dict()
        return {"curve": np.array(made.curve), **{key: values.numpy() for key, values in state.items()}}

    whole = weights("a.pt")
    assert all(map(np.array_equal, whole.values(), weights("b.pt").values()))

    parts = list[float]()

    def stop(stage: str, part: float) -> None:
        parts.extend([part] if stage == "train" else [])
        if stage == "train" and part > 0.6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_network(store, factors, request, tmp_path / "c.pt", Job(progress=stop))
    assert not (tmp_path / "c.pt").exists() and parts == [step / 6 for step in (1, 2, 3, 4)]
    with pytest.raises(MitsimError, match="other pairs, factors or options"):
        train_network(store, factors, request.model_copy(update={"seed": 2}), tmp_path / "c.pt", resume=True)
    half = networks.has_half
    with monkeypatch.context() as patch, pytest.raises(MitsimError, match="or on another processor"):
        patch.setattr(networks, "has_half", lambda device: not half(device))
        train_network(store, factors, request, tmp_path / "c.pt", resume=True)
    unfinished = tmp_path / "d.pt.unfinished"
    unfinished.write_bytes((tmp_path / "c.pt.unfinished").read_bytes()[:-2000])
    with pytest.raises(MitsimError, match=r"d\.pt\.unfinished: cannot be read .*; remove it"):
        train_network(store, factors, request, tmp_path / "d.pt", resume=True)
    again = weights("c.pt", resume=True)
    assert all(map(np.array_equal, whole.values(), again.values()))


def test_a_turned_picture_has_the_frames_of_its_own(tmp_path: Path) -> None:
    """Without noise and misfit, what a batch holds of a turned picture is what its frames would add up to. (Planted:
    data turned and truth not.)"""
    store, factors = FakeStore(8), bench().calibrated(1, error=0.0)
    request = Training(method="unrolled", batch=8)
    prepared = SOLVERS["tikhonov"].init(factors, store.patterns)
    sums = networks.Sums.of(store, prepared, Job())
    exact = prepared.sigma * (prepared.left.basis.T @ sums.truths.astype(np.float64) @ prepared.right.basis)
    network = networks.first_network(request, (16, 16))
    trainer = networks.Trainer(request, prepared, replace(sums, weights=exact), network)
    truths, data = trainer.batch(np.arange(8))
    turned, moved = trainer._turn(truths, data, np.random.default_rng(2))
    assert not torch.equal(turned[4:], truths[4:]) and torch.equal(turned[:4], truths[:4])
    expected = trainer.model.sigma * trainer.model.coefficients(turned) / moved.deviation
    assert_allclose(moved.weights, expected, rtol=2e-4, atol=2e-4 * float(expected.abs().max()))


def test_the_learning_rate_rises_and_falls(monkeypatch: pytest.MonkeyPatch) -> None:
    """A line up to the rate asked for, over 15 % of the steps, then half a cosine to nothing. (Planted: another
    cosine.)"""
    store, request = FakeStore(8), Training(method="refined", steps=40, batch=1, rate=0.02)
    prepared = SOLVERS["tikhonov"].init(bench().calibrated(1), store.patterns)
    sums = networks.Sums.of(store, prepared, Job())
    trainer = networks.Trainer(request, prepared, sums, networks.first_network(request, (16, 16)))
    monkeypatch.setattr(trainer, "gradients", lambda *_: 0.0)
    rates = np.array([trainer.step(number) or trainer.optimiser.param_groups[0]["lr"] for number in range(40)])
    assert_allclose(np.diff(rates[:6]), 0.02 / 6)
    assert_allclose([rates[6], rates[22:24].mean(), rates[39]], [0.02, 0.01, 0], atol=2e-5)


def test_oblong_pictures_are_turned_to_their_own_shape_alone() -> None:
    """(Planted: taken for square.)"""
    model = SimpleNamespace(sigma=torch.ones(()), coefficients=lambda images: images)
    trainer: Any = SimpleNamespace(model=model)
    truths, data = torch.rand(4, 1, 6, 8), Data(torch.zeros(4, 1, 6, 8), torch.ones(4, 1, 1, 1))
    for seed in range(8):
        turned, moved = networks.Trainer._turn(trainer, truths, data, np.random.default_rng(seed))
        assert turned.shape == moved.weights.shape == truths.shape


@pytest.mark.parametrize(("count", "files"), [(24, 24), (100, 3), (2000, 2000), (1200, 12)])
def test_no_photograph_teaches_and_judges(count: int, files: int) -> None:
    """Crops of one photograph stay on one side, for five seeds, and no side is empty; pairs beyond those that judge do
    not teach either; each photograph has its part. (Planted: a permutation of pairs; one part for choosing and judging;
    photographs left out.)"""
    photographs = np.arange(count) % files
    for seed in range(5):
        parts = networks.part_photographs(photographs, seed)
        shown = [set(photographs[part]) for part in parts]
        assert all(len(part) for part in parts) and not any(a & b for a, b in itertools.combinations(shown, 2))
        assert set.union(*shown) == {*photographs}
        assert len(parts[0]) > count / 4 and max(map(len, parts[1:])) <= 48


def test_the_stated_psnr_is_of_photographs_that_neither_teach_nor_choose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a store holds several crops of each. (Planted: the best of the curve stated; the curve of the pairs
    that judge.)"""
    store, asked = FakeStore(12, photographs=4), list[np.ndarray]()
    judge = networks.Trainer.judge

    def note(trainer: Any, pairs: np.ndarray) -> float:
        asked.append(store.photographs[pairs])
        return judge(trainer, pairs)

    monkeypatch.setattr(networks.Trainer, "judge", note)
    made = train_network(store, bench().calibrated(1), Training(method="unrolled", steps=2), tmp_path / "m.pt")
    *looks, before, after = asked
    assert len(looks) == len(made.curve) == 3 and {*np.concatenate(looks)}.isdisjoint({*before, *after})
    summary = made.summary()
    assert (summary["psnr_before_db"], summary["psnr_db"]) == (made.psnr_before_db, made.psnr_db)
    assert made.psnr_db != max(value for _, value in made.curve) and summary["steps"] == 2


def test_trainings_that_are_refused(tmp_path: Path) -> None:
    factors, store = bench().calibrated(1), FakeStore(8)
    hot = FakeStore(8)
    hot._truths = [np.full_like(truth, np.nan) for truth in hot._truths]
    for pairs, camera, seconds, words in (
        (FakeStore(7), factors, 1e5, "holds 7 pairs; give at least 8"),
        (FakeStore(8, photographs=2), factors, 1e5, "its pairs show 2 photographs; give at least 3"),
        (store, replace(factors, left=factors.left[:, :8]), 1e5, "calibrate this camera"),
        (store, factors, 0.01, r"would take about .* s; allowed are 0\.01 s"),
        (hot, factors, 1e5, "diverged at step"),
    ):
        job = Job(limits=Limits(seconds=seconds))
        with pytest.raises(MitsimError, match=words):
            train_network(pairs, camera, Training(method="unrolled", steps=2), tmp_path / "m.pt", job)
    assert not (tmp_path / "m.pt").exists()
    request = Training(method="unrolled", batch=4, steps=1)
    half = 0.6 if networks.has_half(torch.device("cpu")) else 1.0
    # Torch; three networks of 16 channels, each with 100 bytes a channel and pixel; truths and data of 8 pairs.
    needed = 6e8 + 4 * 256 * 3 * 16 * 100 * half + 8 * 256 * 2 * 4
    for bytes_, seconds, words in ((needed - 512, 1e5, "of memory"), (needed + 512, 0.01, "allowed are 0.01 s")):
        job = Job(limits=Limits(seconds=seconds, memory_bytes=bytes_))
        with pytest.raises(MitsimError, match=words):
            train_network(store, factors, request, tmp_path / "m.pt", job)
    prepared = SOLVERS["tikhonov"].init(factors, store.patterns)
    held = 8 * (256 + prepared.sigma.size) * 4  # truths and data of 8 pairs in 32 bits
    networks.Sums.of(store, prepared, Job(limits=Limits(memory_bytes=1.01 * held)))
    with pytest.raises(MitsimError, match=r"reading 8 pairs: would take about .* of memory"):
        networks.Sums.of(store, prepared, Job(limits=Limits(memory_bytes=0.99 * held)))


# -------- Images by a network


def image_of(model: LearnedSolver, patterns: str = "uniform", seed: int = 5, **changes: Any) -> Reconstruction:
    camera = bench(**changes)
    return reconstruct(camera.run(patterns, picture(seed), seed), camera.calibrated(1), method=model)


def test_an_image_says_by_what_it_was_found(model: LearnedSolver, tmp_path: Path) -> None:
    """Better than least squares at the best lambda, of a picture that never taught; without an uncertainty."""
    camera = bench()
    shots, factors = camera.run("uniform", picture(5), 5), camera.calibrated(1)
    found = reconstruct(shots, factors, method=model)
    classical = max(psnr(reconstruct(shots, factors, lam).image, picture(5)) for lam in np.logspace(2, 9, 29))
    assert psnr(found.image, picture(5)) > classical
    assert found.ok and found.uncertainties is None and found.misfit is not None and not found.misfit.flagged
    assert "Computed by a trained network, unrolled " in str(found.status) and "uncertainty is not known" in str(
        found.status
    )
    assert found.inputs["method"] == model.name
    found.save(tmp_path / "image")
    assert not (tmp_path / "image" / "uncertainty.exr").exists()
    with pytest.raises(ArgumentError, match=r"lam 1\.0: unrolled .* has none"):
        reconstruct(shots, factors, 1.0, method=model)


def test_an_image_states_its_part_of_the_frames(model: LearnedSolver) -> None:
    """The residual is the frame less that of the image, written out; frames without noise have that of single
    precision. (Planted: energy outside the model taken off; noise by another power of the energy.)"""
    (shown,), factors = bench().run("uniform", picture(1), 1).pattern_measurements(), bench().calibrated(1)
    solution = model.compute(*summed(model), "auto")
    off = shown.frame - factors.left @ solution.image @ factors.right.T
    assert solution.residual == pytest.approx(np.linalg.norm(off) / np.linalg.norm(shown.frame), rel=1e-6)
    prepared = model.init(factors, model.patterns)
    ideal = factors.left @ picture(1) @ factors.right.T
    assert networks.relative_noise(prepared.problem(prepared.accumulator([(ideal, 0, 0)]))) == pytest.approx(1e-7)


def test_a_file_gives_the_same_image(model: LearnedSolver, tmp_path: Path) -> None:
    model.save(tmp_path / "m.pt")
    again = verbs.load_network(tmp_path / "m.pt")
    assert again.name == model.name and again.manifest == model.manifest
    assert_array_equal(image_of(again).image, image_of(model).image)
    for device in ("abacus", "meta", ""):
        with pytest.raises(ArgumentError, match=f"device '{device}': cannot be used"):
            verbs.load_network(tmp_path / "m.pt", device)


def test_another_bench_is_flagged(model: LearnedSolver) -> None:
    """And refused where it cannot serve. (Planted: each of the four doubts left out; no refusal of another camera.)"""
    camera = bench()
    with pytest.raises(MitsimError, match="trained for the patterns uniform, but this run has others"):
        reconstruct(camera.run("dots:2", picture(5), 5), camera.calibrated(1), method=model)
    small = replace(camera.calibrated(1), right=camera.right[:, :8])
    with pytest.raises(MitsimError, match="makes images of 16 x 16 pixels, but calibration in memory has 16 x 8"):
        model.init(small, model.patterns)
    shots, factors = camera.run("uniform", picture(5), 5), camera.calibrated(1)
    named = {"camera": {"mask": "other"}}
    others = Capture(shots.manifest.model_copy(update=named), memory=shots._memory)
    elsewhere = replace(factors, manifest=factors.manifest.model_copy(update=named))
    assert "trained for another camera: mask differ" in str(reconstruct(others, elsewhere, method=model).status)
    network = networks.CLASSES["flatnet"]((16, 16))
    with pytest.raises(MitsimError, match=r"trained for another camera .mask differ., and its weights contain"):
        reconstruct(others, elsewhere, method=replace(model, network=network))
    moved = image_of(model, shift=0.2)
    assert not moved.ok and "trained with a calibration that differs by" in str(moved.status)
    dim = image_of(model, peak=500.0)
    assert not dim.ok and "trained with noise of" in str(dim.status)
    blind = networks.CLASSES["unrolled"]((16, 16))  # whose frames count for nothing at the end
    blind.load_state_dict(model.network.state_dict())
    with torch.no_grad():
        blind.log_rho += 30
    assert "The image does not explain the frames" in str(image_of(replace(model, network=blind)).status)


@pytest.mark.parametrize("damage", ["empty", "cut", "pickle", "tensors", "nan", "method", "newer", "folder", "none"])
def test_a_file_that_is_none_is_refused(damage: str, model: LearnedSolver, tmp_path: Path) -> None:
    path = tmp_path / "m.pt"
    model.save(path)
    data, held = path.read_bytes(), torch.load(path, weights_only=True)
    manifest, unknown = json.loads(held["manifest"]), {"log_start": torch.tensor(float("nan"))}
    path.unlink()
    if damage in (spoilt := {"empty": b"", "cut": data[:-5000], "pickle": pickle.dumps(Path("x"))}):
        path.write_bytes(spoilt[damage])
    others = {
        "tensors": {"x": torch.zeros(3)},
        "nan": {**held, "weights": {**held["weights"], **unknown}},
        "method": {**held, "manifest": json.dumps({**manifest, "method": "rolled"})},
        "newer": {**held, "manifest": json.dumps({**manifest, "format": 99})},
    }
    if damage in others:
        torch.save(others[damage], path)
    if damage == "folder":
        path.mkdir()
    with pytest.raises(MitsimError, match=r"m\.pt") as refused:
        verbs.load_network(path)
    assert "\n" not in str(refused.value)


def test_a_request_says_what_no_network_is_trained_by() -> None:
    for name, value in (("method", "unroled"), ("steps", 0), ("batch", 1000), ("rate", 0.0), ("rate", float("nan"))):
        with pytest.raises(MitsimError, match=f"^{name} "):
            Training(**{**dict(Training(method="unrolled")), name: value})
