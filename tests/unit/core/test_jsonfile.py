from pathlib import Path

import numpy as np
import pytest

from mitsim.core import files
from mitsim.core.environment import versions as all_versions
from mitsim.core.errors import MitsimError


def test_json_comes_back(tmp_path: Path) -> None:
    written = {"array": np.array([[1.5, 2.0]]), "count": np.int64(2**40), "where": Path("a/b"), "pair": (1, True)}
    plain = {"array": [[1.5, 2.0]], "count": 2**40, "where": "a/b", "pair": [1, True]}
    files.write_json(tmp_path / "m.json", {**written, "none": None, "worst": np.inf, "name": "µm"})
    assert files.read_json(tmp_path / "m.json") == {**plain, "none": None, "worst": None, "name": "µm"}
    assert [item.name for item in tmp_path.iterdir()] == ["m.json"]


def test_what_json_cannot_hold_is_refused_and_the_old_file_stays(tmp_path: Path) -> None:
    files.write_json(tmp_path / "m.json", {"a": 1})
    with pytest.raises(TypeError, match="object"):
        files.write_json(tmp_path / "m.json", {"a": object()})
    assert files.read_json(tmp_path / "m.json") == {"a": 1}


def test_reading_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(MitsimError, match=r"m\.json: cannot be read"):
        files.read_json(tmp_path / "m.json")
    (tmp_path / "m.json").write_text('{"a": ')
    with pytest.raises(MitsimError, match=r"m\.json: not valid JSON"):
        files.read_json(tmp_path / "m.json")


def test_versions_names_what_decides_the_numbers() -> None:
    versions = all_versions()
    assert {"mitsim", "mitsuba", "drjit", "numpy", "python"} <= set(versions)
    assert versions["numpy"] == np.__version__
