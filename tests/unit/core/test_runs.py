"""A capture in memory and the folder that the command line writes are the same thing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mitsim.core.errors import MitsimError
from mitsim.core.exr import read_frame
from mitsim.core.manifests import Digital, Patterns, RunHead, RunManifest
from mitsim.core.runs import Capture, Recorder, claim_run, frame_name, load_run
from mitsim.devices.patterns import parse_patterns

N, PIXELS = 6, 5
CONFIGURATION = {"scene": "none", "seed": 3}


def recorded(to: Recorder, patterns: str = "hadamard:2") -> Capture:
    """Frames of random numbers, recorded as `mitsim capture` does."""
    family = parse_patterns(patterns, N)
    rng = np.random.default_rng(8)
    to.begin()
    to.write_truth(rng.random((N, N)), 0.99, np.full((N, N), 2e-3))
    for index, shot in enumerate(family.shots):
        electrons = rng.random((PIXELS, PIXELS), dtype=np.float32) * 1000
        dn = rng.poisson(electrons).astype(np.uint32)
        metadata = {"row": shot.row, "column": shot.column, "sign": shot.sign, "exposure_s": 0.02, "seed": 3}
        assert not to.keeps(index)
        to.write_frame(index, {"DN": dn, "electrons": electrons}, metadata)
    head = RunHead.of(CONFIGURATION)
    return to.finish(
        RunManifest(
            configuration=head.configuration,
            configuration_sha256=head.configuration_sha256,
            camera={"name": "bench", "well": float("inf")},
            digital=Digital(exposure_s=0.02, gain_dn_per_e=0.5, black_level_dn=40.0, dark_current_e_per_s=6.0),
            patterns=Patterns.of(family, [frame_name(index) for index in range(len(family.shots))]),
            plan={"effects": []},
            warnings=("too dark",),
        )
    )


def on_disk(folder: Path) -> Capture:
    with claim_run(folder, RunHead.of(CONFIGURATION), resume=False) as run:
        return recorded(run)


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_saved_capture_is_the_folder_that_was_streamed(tmp_path: Path) -> None:
    """To the byte: names, pixels, metadata, checksums, manifest. (Planted: metadata without the run's digest.)"""
    on_disk(tmp_path / "streamed")
    recorded(Recorder()).save(tmp_path / "saved")
    load_run(tmp_path / "streamed").save(tmp_path / "copied")
    expected = content(tmp_path / "streamed")
    assert len(expected) == 4 * 2 + 2
    assert content(tmp_path / "saved") == expected and content(tmp_path / "copied") == expected
    channels, metadata = read_frame(tmp_path / "saved" / frame_name(3))
    assert metadata["run"] == RunHead.of(CONFIGURATION).configuration_sha256 and metadata["index"] == 3
    assert len(str(metadata["pixels_sha256"])) == 64 and metadata["exposure_s"] == 0.02
    assert set(channels) == {"DN", "electrons"}


def test_memory_and_disk_give_the_same_arrays(tmp_path: Path) -> None:
    memory, streamed = recorded(Recorder()), on_disk(tmp_path / "run")
    for shots in (streamed, load_run(tmp_path / "run")):
        assert shots.dn.dtype == memory.dn.dtype == np.uint32 and np.array_equal(shots.dn, memory.dn)
        assert shots.electrons is not None and np.array_equal(shots.electrons, memory.electrons)
        assert np.array_equal(shots.truth_standard_error, np.full((N, N), np.float32(2e-3)))
        assert np.array_equal(shots.truth, memory.truth) and shots.truth_board == memory.truth_board == 0.99
        assert shots.exposure_s == 0.02 and shots.plan == {"effects": []} and shots.warnings == ("too dark",)
        assert shots.manifest.camera == memory.manifest.camera, "an infinite well is null in both"
        assert shots.fingerprint == memory.fingerprint
        for (a, *index), (b, *other_index) in zip(shots.measurements(), memory.measurements(), strict=True):
            assert np.array_equal(a, b) and index == other_index
    assert memory.dn.base is None and np.shares_memory(memory.dn, memory._memory[frame_name(2)][0]["DN"])


def test_a_measurement_is_the_difference_of_its_halves() -> None:
    shots = recorded(Recorder())
    rates = [(dn.astype(float) - 40) / 0.5 / 0.02 - 6 for dn in shots.dn]
    expected = {(0, 0): 0, (0, 1): 2, (1, 0): 4, (1, 1): 6}
    measured = {(i, j): frame for frame, i, j in shots.measurements()}
    assert set(measured) == set(expected)
    for index, first in expected.items():
        np.testing.assert_allclose(measured[index], rates[first] - rates[first + 1], rtol=1e-12, atol=1e-9)


def test_frames_are_read_when_they_are_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    on_disk(tmp_path / "run")
    read: list[str] = []

    def counted(original: Callable[[Path], object]) -> Callable[[Path], object]:
        return lambda path: read.append(path.name) or original(path)

    monkeypatch.setattr("mitsim.core.runs.read_frame", counted(__import__("mitsim.core.runs").core.runs.read_frame))
    shots = load_run(tmp_path / "run")
    assert shots.patterns[0].shape == (N, 2) and not read
    frames = shots.measurements()
    next(frames)
    assert read == [frame_name(0), frame_name(1)]


def test_it_shows_itself(tmp_path: Path) -> None:
    for shots in (recorded(Recorder()), on_disk(tmp_path / "run")):
        text = shots._repr_html_()
        assert text.count("data:image/png;base64,") == 4 and "hadamard:2" in text and "8 shots of 5 x 5" in text
        assert "too dark" in text and "pattern (" in text and " DN" in text
    assert repr(recorded(Recorder())) == "Capture(hadamard:2: 8 shots of 5 x 5 pixels, in memory)"


def test_an_unfinished_run_says_how_to_go_on(tmp_path: Path) -> None:
    """Repeating the command must not end in advice that throws finished frames away."""
    run = tmp_path / "run"
    on_disk(run)
    with claim_run(run, RunHead.of(CONFIGURATION), resume=True) as again:
        again.begin()
    with (
        pytest.raises(MitsimError, match="holds files already; continue with resume=True"),
        claim_run(run, RunHead.of(CONFIGURATION), resume=False),
    ):
        pass
    with (
        pytest.raises(MitsimError, match=r"resume=True: .* another configuration \(seed differ\)"),
        claim_run(run, RunHead.of({**CONFIGURATION, "seed": 4}), resume=True),
    ):
        pass


def test_a_truth_of_before_has_no_standard_error() -> None:
    """Nor has a real camera's capture."""
    record = Recorder()
    record.write_truth(np.full((N, N), 0.5), 0.99)
    shots = Capture(recorded(Recorder()).manifest, memory=record.files)
    assert shots.truth is not None and shots.truth_standard_error is None
    assert Capture(shots.manifest, memory={}).truth_standard_error is None
