from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mitsim.core.errors import MitsimError
from mitsim.core.exr import checksum, read_frame, write_frame

DN = np.array([[0, 1, 4095], [2**24 + 1, 2**32 - 1, 7]], dtype=np.uint32)
ELECTRONS = np.array([[0.1, -1.5, 3e30], [np.inf, 1e-30, 2.0]], dtype=np.float32)


def test_channels_and_metadata_come_back_bit_for_bit(tmp_path: Path) -> None:
    # 2^40 and 0.1 do not fit EXR's own 32-bit header numbers.
    metadata = {"seed": 2**40, "exposure_s": 0.1, "name": 'Zürich\n"x"', "count": np.int64(3)}
    stated = write_frame(tmp_path / "a.exr", {"DN": DN, "electrons": ELECTRONS}, metadata)
    channels, read = read_frame(tmp_path / "a.exr")
    assert stated == checksum(tmp_path / "a.exr")
    assert set(channels) == {"DN", "electrons"}
    assert channels["DN"].dtype == np.uint32 and np.array_equal(channels["DN"], DN)
    assert channels["electrons"].dtype == np.float32 and np.array_equal(channels["electrons"], ELECTRONS)
    assert read == metadata and type(read["seed"]) is int and type(read["exposure_s"]) is float


@settings(max_examples=12, deadline=None)
@given(value=st.one_of(st.text(max_size=40), st.integers(), st.floats(allow_nan=False)))
def test_any_metadata_value_comes_back(tmp_path_factory: pytest.TempPathFactory, value: str | int | float) -> None:
    path = tmp_path_factory.getbasetemp() / "any_metadata.exr"
    write_frame(path, {"DN": DN}, {"value": value})
    assert read_frame(path)[1] == {"value": value}


@pytest.mark.parametrize(
    ("channels", "error"),
    [
        ({}, ValueError),
        ({"DN": DN, "electrons": ELECTRONS[:, :2]}, ValueError),
        ({"DN": DN[0]}, ValueError),
        ({"DN": DN.astype(np.float64)}, TypeError),
        ({"DN": DN.astype(np.int32)}, TypeError),
    ],
)
def test_nothing_is_converted_silently(tmp_path: Path, channels: dict, error: type[Exception]) -> None:
    with pytest.raises(error, match="write_frame"):
        write_frame(tmp_path / "a.exr", channels, {})
    assert not list(tmp_path.iterdir())


def test_missing_and_foreign_files_are_told_apart(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match="No such file"):
        read_frame(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("not a picture")
    with pytest.raises(MitsimError, match="not an OpenEXR file"):
        read_frame(tmp_path / "text.exr")
    with pytest.raises(MitsimError, match="cannot be written"):
        write_frame(tmp_path / "no" / "a.exr", {"DN": DN}, {})


def test_a_frame_of_another_program_is_read(tmp_path: Path) -> None:
    half = np.array([[0.5, 1.5]], dtype=np.float16)
    header = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage, "owner": "camera"}
    OpenEXR.File(header, {"Y": half}).write(str(tmp_path / "a.exr"))
    channels, metadata = read_frame(tmp_path / "a.exr")
    assert channels["Y"].dtype == np.float32 and np.array_equal(channels["Y"], half.astype(np.float32))
    assert metadata == {}


def test_checksum_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")  # the test vector of FIPS 180-2
    assert checksum(tmp_path / "a") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    with pytest.raises(MitsimError, match="cannot be read"):
        checksum(tmp_path / "b")
