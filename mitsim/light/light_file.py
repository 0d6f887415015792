"""Light by projector pixel in an HDF5 file, from which NumPy and SciPy form the frame of any pattern.

The file has sparse matrices for the light, and dense factors for the mask's shadow. docs/exchange.md has the layout.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from mitsim.core.arrays import PACKED, FloatArray, whole_hdf5
from mitsim.core.errors import MitsimError
from mitsim.light.light import SampledLight
from mitsim.light.passes import GRIDS, Grid
from mitsim.optics.image_formation import anchor_positions, anchor_weights
from mitsim.optics.terms import shadow_terms
from mitsim.sensor.chain import electrons_from_irradiance
from mitsim.version import __version__

if TYPE_CHECKING:
    import h5py


LAYOUT, LAYOUT_OF_TWO_SIDES = 1, 2
"""The second version has separate weights of anchors for columns."""
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
