"""Light by projector pixel in an HDF5 file, from which NumPy and SciPy form the frame of any pattern.

The file has sparse matrices for the light, dense factors for the mask's shadow, and the plan for exposing the light
again. docs/exchange.md has the layout.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from mitsim.bench.apparatus import Apparatus
from mitsim.core.arrays import PACKED, FloatArray, checked_hdf5, hdf5_errors, whole_hdf5
from mitsim.core.errors import MitsimError
from mitsim.core.files import parse_json
from mitsim.light.light import SampledLight
from mitsim.light.passes import GRIDS, Grid, LightEstimate
from mitsim.light.plan import Plan
from mitsim.light.settings import GROUPS
from mitsim.light.simulation import Simulation
from mitsim.optics.image_formation import anchor_positions, anchor_weights
from mitsim.optics.terms import shadow_terms
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.version import __version__

if TYPE_CHECKING:
    import h5py


LAYOUT, LAYOUT_OF_TWO_SIDES = 1, 2
"""The second version has separate weights of anchors for columns."""
_KEPT = "kept"
_COPIES = 4
"""Bytes of memory for a byte of the file, because numbers are widened and rows joined."""
_SPECULAR_BYTES = 2**31
"""Memory of frames of light over mirrors, one for each projector pixel."""


def write_light(path: Path, light: SampledLight) -> None:
    """Write light by projector pixel to one file as a whole.

    Raises MitsimError for light by class, too many projector pixels with light over mirrors, or an unwritable file.
    """
    count = light.bench.n**2
    if not np.array_equal(light.labels, np.arange(count)):
        raise MitsimError(f"file {path}: the light was traced for one family alone; trace it by pixel, by bench.light")
    specular = _specular(path, light)
    with whole_hdf5(path) as file:
        file.attrs.update(_facts(light))
        grids = file.create_group("light", track_order=True)
        for name, row in GRIDS.items():
            groups = [group[name][:count] for group in light.groups]
            if any(group.nnz for group in groups):
                place = grids.create_group(row.key, track_order=True)
                _write_matrix(place, sparse.csr_array(sparse.vstack(groups, format="csr")))
                _write_shadow(place, light.simulation.grids[name])
        if light.simulation.physics.lamps:
            file.create_dataset("ambient", data=_ambient(light).astype(np.float32), **PACKED)
        if specular is not None:
            _write_matrix(file.create_group("glint", track_order=True), specular)
        if light.plan.request is not None:
            _keep(file.create_group(_KEPT, track_order=True), light)


def _keep(group: h5py.Group, light: SampledLight) -> None:
    facts = {name: getattr(light, name) for name in ("paths", "reached", "restated")}
    group.attrs.update({**facts, "samples": json.dumps(dict(light.samples))})
    for name in ("flux", "flux_error"):
        group.create_dataset(name, data=getattr(light, name), **PACKED)
    for name in ("received", "outside"):
        group.create_dataset(name, data=[getattr(each, name) for each in light.groups])
    group.create_dataset("plan", data=light.plan.as_text())
    for name in GRIDS:
        lamps = sparse.vstack([each[name][[light.bench.n**2]] for each in light.groups], format="csr")
        if lamps.nnz:
            _write_matrix(group.create_group(GRIDS[name].key, track_order=True), sparse.csr_array(lamps))


def read_light(path: Path, bench: Apparatus) -> SampledLight:
    """Read a file of :func:`write_light`, to single precision, for the bench on which the light was traced.

    Raises MitsimError for an unreadable or other file, and for light of another bench or version of mitsim.
    """
    with hdf5_errors(path), checked_hdf5(path, lambda _: _COPIES) as file:
        if _KEPT not in file:
            raise MitsimError(f"light {path}: is no file of this version's `mitsim transport`; trace it again")
        kept, count = file[_KEPT], bench.n**2
        plan = Plan.of_data(parse_json(kept["plan"][()].decode()), f"light {path}")
        plan.check_made_of(bench.deciding, "light")
        simulation = Simulation(bench, plan.settings)
        light = {
            name: _groups_of(file["light"], kept, name, grid.bundle.size, count)
            for name, grid in simulation.grids.items()
        }
        facts = zip(kept["received"][:GROUPS].tolist(), kept["outside"][:GROUPS].tolist(), strict=True)
        groups = [
            LightEstimate({name: each[number] for name, each in light.items()}, *totals)
            for number, totals in enumerate(facts)
        ]
        flux, flux_error = (_numbers(kept[name], (count,)) for name in ("flux", "flux_error"))
        return SampledLight(
            tuple(groups), simulation, plan, int(file.attrs["seed"]), np.arange(count), flux, flux_error,
            int(kept.attrs["paths"]), float(file.attrs["mc_error"]), bool(kept.attrs["reached"]),
            {str(name): int(samples) for name, samples in json.loads(kept.attrs["samples"]).items()},
            restated=float(kept.attrs["restated"]),
        )  # fmt: skip


def _groups_of(light: h5py.Group, lamps: h5py.Group, name: str, size: int, count: int) -> list[sparse.csr_array]:
    key, rows = GRIDS[name].key, (count, 1)
    parts = [
        _read_matrix(place[key], (GROUPS * each, size)) if key in place else sparse.csr_array((GROUPS * each, size))
        for place, each in zip((light, lamps), rows, strict=True)
    ]
    return [
        sparse.csr_array(
            sparse.vstack([part[number * each : (number + 1) * each] for part, each in zip(parts, rows, strict=True)])
        )
        for number in range(GROUPS)
    ]


def _read_matrix(group: h5py.Group, shape: tuple[int, int]) -> sparse.csr_array:
    stored = tuple(group.attrs["shape"].tolist())
    if stored != shape:
        raise ValueError(f"{group.name} is {stored}, and the plan has {shape}")
    entries = group["indices"].shape
    parts = _numbers(group["data"], entries), group["indices"][:], group["indptr"][:]
    matrix = sparse.csr_array(parts, shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def _numbers(values: h5py.Dataset, shape: tuple[int, ...]) -> FloatArray:
    found = np.asarray(values[:], dtype=np.float64)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"{values.name} holds other than {shape} finite numbers")
    return found


def _facts(light: SampledLight) -> dict[str, Any]:
    bench, plan, devices = light.bench, light.plan, light.bench.devices
    rows, columns = bench.geometry.frame_shape
    joule = electrons_from_irradiance(1.0, 1.0, devices.sensor, devices.projector.effective_wavelength_nm)
    return {
        "mitsim_transport": LAYOUT if bench.geometry.axes_alike else LAYOUT_OF_TWO_SIDES,
        "mitsim_version": __version__,
        "n": bench.n,
        **({"pixels": rows} if rows == columns else {}),
        "rows": rows,
        "columns": columns,
        "groups": len(light.groups),
        "black_level": light.simulation.physics.black_level,
        "electrons_per_j_m2": float(joule),
        "patterns": plan.request.patterns if plan.request else "",
        "accuracy": plan.accuracy,
        "seed": light.seed,
        "mc_error": light.sampling_error,
        "total_error_bound": light.error_bound,
        "lost_light": light.lost,
        "provenance": json.dumps({**bench.provenance(), **bench.identity()}, default=str),
        "warnings": json.dumps([*light.warnings, *light.unreached]),
    }


def _write_matrix(group: h5py.Group, matrix: sparse.csr_array) -> None:
    group.attrs["shape"] = matrix.shape
    parts = {"data": np.float32, "indices": np.int64 if matrix.shape[1] > 2**31 else np.int32, "indptr": np.int64}
    for name, kind in parts.items():
        group.create_dataset(name, data=getattr(matrix, name).astype(kind), **PACKED)


def _write_shadow(group: h5py.Group, grid: Grid) -> None:
    bundle, geometry, spectrum, _ = grid.key
    layers = [shadow_terms(geometry, bundle.rows, bundle.columns, depth, spectrum) for depth in bundle.depths]
    for side, name in enumerate(("left", "right")):
        factors = np.stack([[term[side] for term in terms] for terms in layers])
        group.create_dataset(name, data=factors.astype(np.float32), **PACKED)
    positions = anchor_positions(bundle.anchors, geometry.half_width)
    arrays = {
        "anchors": anchor_weights(positions, geometry.centres(0)),
        **({"column_anchors": anchor_weights(positions, geometry.centres(1))} if not geometry.axes_alike else {}),
        "rows": bundle.rows.centres,
        "columns": bundle.columns.centres,
        "depths_mm": np.array(bundle.depths),
    }
    for name, values in arrays.items():
        group.create_dataset(name, data=values)


def _ambient(light: SampledLight) -> FloatArray:
    frames = np.zeros((len(light.groups), *light.bench.geometry.frame_shape))
    for accumulated in light.simulation.with_optics(light.groups, light.bench.n**2)[1]:
        for frame, group in zip(frames, accumulated.groups, strict=True):
            group.sort_indices()
            frame += accumulated.optics.frame(group.indices, group.data)
    return frames


def _specular(path: Path, light: SampledLight) -> sparse.csr_array | None:
    if not light.simulation.physics.mirrors:
        return None
    (rows, columns), count = light.bench.geometry.frame_shape, light.bench.n**2
    shining = len(np.unique(light.bench.specular.beams.pixel))
    if shining * rows * columns * 8 > _SPECULAR_BYTES:
        raise MitsimError(
            f"file {path}: {shining} projector pixels shine over mirrors, in frames of over {_SPECULAR_BYTES >> 30} "
            f"GiB at {rows}x{columns}; leave the mirror out, or take a sensor of fewer pixels"
        )
    found = light.simulation.specular_frames(light.labels)
    if found is None:
        return None
    lit = sparse.csr_array(found.irradiance.reshape(len(found.classes), -1))
    places = np.ones(len(found.classes)), (found.classes, np.arange(len(found.classes)))
    return sparse.csr_array(sparse.csr_array(places, shape=(count, len(found.classes))) @ lit)
