"""Pairs as a data set for other programs: a folder that Hugging Face `datasets` and torch read, with a data card.

The layout is that of `imagefolder` (https://huggingface.co/docs/datasets/image_dataset): a folder for each split, with
images and `metadata.jsonl`, where values of keys that end in `file_name` are images. Image and truth share the grid of
the projector's pixels. Files are TIFF of 32-bit real numbers, because PNG would clip and round reflectances.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from mitsim.core.errors import ArgumentError, MitsimError, cut
from mitsim.core.files import whole_folder, write_text
from mitsim.core.images import write_numbers
from mitsim.core.job import Cost, Limits
from mitsim.core.parallel import single_threaded_blas
from mitsim.devices.patterns import short_name
from mitsim.learn.pair_store import PairStore, check_sizes, part_photographs
from mitsim.learn.requests import FEWEST_PHOTOGRAPHS
from mitsim.metrics import psnr
from mitsim.reconstruct.accumulation import Model, lacking_light
from mitsim.reconstruct.factors import Factors, camera_parts, load_calibration
from mitsim.reconstruct.request import TIKHONOV
from mitsim.reconstruct.solvers import SOLVERS
from mitsim.version import __version__

SPLITS = "train", "validation", "test"
_NUMBERS = {
    **dict.fromkeys(("pair", "photograph", "group"), "int64"),
    **dict.fromkeys(("exposure_s", "lambda", "psnr_db"), "float64"),
}
"""Types of the numbers of a pair, by the names that a data card has for them."""
_PAIR_BYTES = 2048
"""Bytes of a pair beside its pixels: two headers and a line."""
_CARD = """
# {title}

Pictures as a simulated lensless camera sees them under the patterns {patterns}, made by mitsim. `truth` is reflectance
relative to a white board, and `image` its estimate from noisy frames by Tikhonov's method with automatic lambda. Both
have {n} x {n} pixels of 32 bits and are neither clipped nor scaled. No photograph is in two splits.

    from datasets import load_dataset
    pairs = load_dataset("imagefolder", data_dir="FOLDER").with_format("torch")

State the licence in the head before you share the folder: pictures of others keep their own.
"""


def open_pairs(pairs: Path, calibration: Path | str | None) -> tuple[PairStore, Path, Factors]:
    """Return a store, and place and factors of its calibration; by default that in the store's folder.

    MitsimError if one is missing or damaged, or if the calibration has another camera or other sizes.
    """
    store, place = PairStore.open(pairs), pairs / "calibration" if calibration is None else Path(calibration)
    if calibration is None and not place.is_dir():
        raise ArgumentError("calibration", f"is not given, and {pairs} holds none; give the folder of its camera")
    factors = load_calibration(place)
    ours, theirs = (camera_parts(each.manifest.camera) for each in (store, factors))
    if names := [cut(name) for name in sorted({*ours, *theirs}) if ours.get(name) != theirs.get(name)]:
        differ = f"{', '.join(names)} differ{'s' if len(names) == 1 else ''}"
        raise MitsimError(f"calibration {place}: is of another camera than {pairs}: {differ}; calibrate that camera")
    check_sizes(store, factors)
    return store, place, factors


@single_threaded_blas()
def write_dataset(pairs: Path, output: Path, calibration: Path | str | None) -> dict[str, Any]:
    """Write pairs as a data set with a data card, whole or not at all, and return what the export reports.

    Splits are those of a training with seed 0. MitsimError as for :func:`open_pairs`, and for too little time or disk.
    """
    store, place, factors = open_pairs(pairs, calibration)
    made, photographs, count = store.manifest, store.photographs, len(store)
    prepared, flagged = SOLVERS[TIKHONOV].init(factors, store.patterns), Counter[str]()
    model = Model(prepared, factors.sides, store.patterns)
    parts: tuple[Any, ...] = (np.arange(count),)
    if len(np.unique(photographs)) >= FEWEST_PHOTOGRAPHS:
        parts = part_photographs(photographs, 0, None)
    splits = {split: chosen.tolist() for split, chosen in zip(SPLITS, parts, strict=False)}
    group_of = {index: shard.group for shard in made.shards for index in range(shard.first, shard.first + shard.count)}

    def write_pair(index: int, folder: Path) -> dict[str, Any]:
        measured, file = zip(store.frames(index), *store.indices.T, strict=True), f"pair_{index:06d}.tif"
        sums, truth = prepared.accumulator(measured), store.truth(index)
        found = prepared.solve(sums)
        if factors.lacking:  # as for the image of a run
            found = prepared.solve(sums, lack=lacking_light(model, factors.lacking, found.image))
        write_numbers(folder / "images" / file, found.image.astype(np.float32))
        write_numbers(folder / "truths" / file, truth)
        flagged.update(found.status.reasons)
        numbers = int(photographs[index]), group_of[index], store.exposure_s(index), found.lam, psnr(found.image, truth)
        drawn = made.groups[group_of[index]] if made.groups else {}
        files = {"file_name": f"images/{file}", "truth_file_name": f"truths/{file}"}
        return {**files, **dict(zip(_NUMBERS, (index, *numbers), strict=True)), **drawn}

    with whole_folder(output) as folder:
        started, disk_bytes = time.perf_counter(), count * (8.0 * made.n**2 + _PAIR_BYTES)
        for split, chosen in splits.items():
            rows = list[str]()
            for name in ("images", "truths"):
                (folder / split / name).mkdir(parents=True)
            for index in chosen:
                rows.append(json.dumps(write_pair(index, folder / split), allow_nan=False))
                if split == SPLITS[0] and len(rows) == 1:
                    cost = Cost(count * (time.perf_counter() - started), disk_bytes=disk_bytes)
                    cost.check(f"{pairs}: a data set of {count} pairs", Limits(), folder)
            write_text(folder / split / "metadata.jsonl", "".join(f"{row}\n" for row in rows))
        write_text(folder / "README.md", _card(store, factors))
    sizes = ", ".join(f"{len(chosen)} in {split}" for split, chosen in splits.items())
    notes = [f"{sizes}; read them by load_dataset('imagefolder', data_dir={str(output)!r})"]
    notes += [f"The pairs are flagged: {warning}" for warning in made.warnings]
    notes += [f"{number} of {count} images are flagged: {reason}" for reason, number in flagged.items()]
    return {
        "frames": count * made.frames,
        "pairs": count,
        "calibration": str(place),
        "notes": notes,
        "output": str(output),
    }


def _card(store: PairStore, factors: Factors) -> str:
    """Return the text of README.md; each line of its head is YAML, and after the name JSON."""
    made, patterns = store.manifest, short_name(store.manifest.patterns)
    scene = "/".join(Path(made.scene).parts[-2:])
    kinds = {**dict.fromkeys(("image", "truth"), "image"), **_NUMBERS}
    kinds |= dict.fromkeys(made.groups[0] if made.groups else (), "float64")
    head = {
        "license": "unknown",
        "pretty_name": f"{scene} under {patterns}",
        "task_categories": ["image-to-image"],
        "tags": ["lensless-imaging"],
        "dataset_info": {"features": [{"name": name, "dtype": kind} for name, kind in kinds.items()]},
        "mitsim": {
            "scene": scene,
            "patterns": patterns,
            "camera": json.loads(made.sensor)["name"],
            "seed": made.seed,
            "pictures": f"{len(made.photographs)} files" if made.photographs else made.pictures,
            "method": TIKHONOV,
            "factors_sha256": factors.fingerprint,
            "versions": {**made.versions, "exported by": __version__},
        },
    }
    lines = [f"{name}: {json.dumps(value)}" for name, value in head.items()]
    return "\n".join(["---", *lines, "---", _CARD.format(title=head["pretty_name"], patterns=patterns, n=made.n)])
