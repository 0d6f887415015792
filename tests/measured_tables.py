"""Tables of materials in the format of the RGL database: a Lambertian, GGX, and one of random numbers."""

import struct
from pathlib import Path

import numpy as np

COUNT, ANGLES = 64, 24


def save(path: Path, fields: dict[str, np.ndarray]) -> None:
    """Write Mitsuba's tensor format: a header, a record a field, and the values from multiples of 8 bytes on."""
    records = {name: struct.pack("<H", len(name)) + name.encode() for name in fields}
    start = 18 + sum(len(records[name]) + 11 + 8 * each.ndim for name, each in fields.items())
    head, body = struct.pack("<12sBBI", b"tensor_file", 1, 0, len(fields)), b""
    start += -start % 8
    for name, each in fields.items():
        head += records[name] + struct.pack("<HBQ", each.ndim, 1 if each.dtype == np.uint8 else 10, start + len(body))
        head += struct.pack(f"<{each.ndim}Q", *each.shape)
        body += each.tobytes() + bytes(-each.nbytes % 8)
    path.write_bytes(head.ljust(start, b"\0") + body)


def fields(values: np.ndarray, luminance: np.ndarray, spectra: bool = True, **others: object) -> dict[str, np.ndarray]:
    """Fields of f cos(theta_o) by (phi_i, theta_i, phi_m, theta_m), alike at all wavelengths."""
    one = np.ones((2, 2))
    parts, angles = values.shape[:2]
    given = {"phi_i": [0.0], "theta_i": np.linspace(0, np.pi / 2, angles), "ndf": one, "sigma": one,
             "vndf": np.ones((parts, angles, 2, 2)), "luminance": luminance,
             "spectra" if spectra else "rgb": np.repeat(values[:, :, None], 2 if spectra else 3, axis=2),
             **({"wavelengths": [400, 700]} if spectra else {})} | others  # fmt: skip
    floats = {name: np.asarray(each, dtype=np.float32) for name, each in given.items()}
    divided = np.array(["ndf" in others], dtype=np.uint8)
    return floats | {"jacobian": divided, "description": np.frombuffer(b"test", np.uint8)}


def known(alpha: float | None, albedo: float = 0.5, spectra: bool = True) -> dict[str, np.ndarray]:
    """A Lambertian, or metal of GGX (Walter et al. 2007, Fresnel 1) whose D is the table's ``ndf``."""
    u = np.linspace(0, 1, COUNT)
    theta, phi_m, theta_m = np.meshgrid(np.linspace(0, np.pi / 2, ANGLES), (2 * u - 1) * np.pi, np.pi / 2 * u**2,
                                        indexing="ij")  # fmt: skip
    m = np.stack([np.sin(theta_m) * np.cos(phi_m), np.sin(theta_m) * np.sin(phi_m), np.cos(theta_m)])
    wi = np.stack([np.sin(theta), 0 * theta, np.cos(theta)])
    met = (wi * m).sum(axis=0)
    cosine = 2 * met * m[2] - wi[2]
    tan2 = lambda cos: 1 / np.maximum(cos, 1e-6) ** 2 - 1  # noqa: E731
    others, values = {}, albedo / np.pi * cosine
    whole = values
    if alpha is not None:
        smith = lambda cos: 2 / (1 + np.sqrt(1 + alpha**2 * tan2(cos)))  # noqa: E731
        ggx = lambda cos: 1 / (np.pi * alpha**2 * np.maximum(cos, 1e-6) ** 4 * (1 + tan2(cos) / alpha**2) ** 2)  # noqa: E731
        # f cos_o = [G1(o)] D / (4 sigma), sigma = cos_i / G1(i); both tables by sqrt(theta) along the columns.
        theta_i = np.maximum(np.cos(np.pi / 2 * np.linspace(0, 1, 512) ** 2), 1e-3)
        others = {"ndf": np.tile(ggx(np.cos(np.pi / 2 * np.linspace(0, 1, 512) ** 2)), (2, 1)),
                  "sigma": np.tile(theta_i / smith(theta_i), (2, 1))}  # fmt: skip
        values = smith(cosine)
        whole = values * ggx(m[2])
    lit = (cosine > 0) & (met > 0)
    weight = np.where(lit, whole * np.sqrt(theta_m) * np.sin(theta_m) * met, 0) + 1e-6
    return fields(np.where(lit, values, 0)[None], weight[None], spectra, **others)


def random(parts: int, spectra: bool) -> dict[str, np.ndarray]:
    """Numbers without any symmetry, over a part of a turn."""
    draw = np.random.default_rng(parts).uniform
    size = (5, 4, 6, 6)
    others = {"phi_i": -np.pi + np.linspace(0, 2 * np.pi / parts, 5), "vndf": draw(0.5, 1, (5, 4, 5, 7)),
              "ndf": draw(0.5, 1, (4, 3)), "sigma": draw(0.5, 1, (3, 4))}  # fmt: skip
    return fields(draw(0, 0.2, size), draw(0.5, 1, size), spectra, **others)
