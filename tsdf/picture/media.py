"""Media for kernels: free paths, mean cosines and spectra of absorption as numbers per medium and component.

Light that a wavelength's absorption takes is an exponent times an amount of matter crossed, so that one walk serves all
wavelengths. An amount counts path lengths within grains [unit], or, at levels where grains are points, grains met;
there, and only at levels of similar media, one more amount per medium counts the length flown.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tsdf.data.table import Table
from tsdf.picture import image
from tsdf.scene.levels import Traits
from tsdf.scene.medium import Component, VolumeParameters, free_path, volume_parameters
from tsdf.scene.scene import Absorption, MediumSpec, Scene
from tsdf.scene.specs import VISIBLE_NM, absorption_at, called, held
from tsdf.walk.lights import LUMINANCE
from tsdf.walk.walker import UNENDING, Attenuation, Media

DARKEST = 1e-300  # albedo, so that it has a logarithm
BEYOND = 0.05  # [%] of the luminance of white, from wavelengths outside `KNOWN_NM`: 0.042
LONGEST_OFFSET = math.sqrt(8.0)  # [R] r and z drawn independently: at most 2 each


class Spectra(NamedTuple):
    """Absorption coefficient of a component [1/unit].

    by_wavelength (k,), None where it is given by channel; by_channel (3,), zero where it is given by wavelength.
    """

    by_wavelength: np.ndarray | None
    by_channel: np.ndarray

    @property
    def absorbs(self) -> bool:
        """Whether any light is absorbed at all."""
        return bool(self.by_channel.any() or (self.by_wavelength is not None and self.by_wavelength.any()))

    @property
    def least(self) -> float:
        """The least coefficient of any wavelength or channel [1/unit]."""
        return float(self.by_channel.min() if self.by_wavelength is None else self.by_wavelength.min())

    def grey(self, weight: np.ndarray) -> float:
        """Return its mean by luminance, where wavelengths weigh (k, 3) in linear RGB [1/unit]."""
        by_channel = self.by_channel if self.by_wavelength is None else weight.T @ self.by_wavelength
        return float(np.array(LUMINANCE) @ by_channel)


def spectra_of(spec: Absorption, metres_per_unit: float | None) -> Spectra:
    """Return what a scene says of a component's absorption, by wavelength or by channel."""
    if spec.kind == "grey":
        return Spectra(None, np.full(3, spec.coefficient[0]))
    if spec.kind == "rgb":
        return Spectra(None, np.array(spec.coefficient))
    return Spectra(absorption_at(spec, image.spectral_weights().wavelength_nm, metres_per_unit), np.zeros(3))


def notes_of(scene: Scene) -> list[str]:
    """Return what is to be said of spectra that end where light is still seen, one line for each of a medium."""
    notes = {}
    for number, medium in enumerate(scene.media, 1):
        for grain in medium.grains:
            if (ends := held(grain.absorption)) is not None:
                of = f"absorption of {grain.absorption.material}" if grain.absorption.material else "absorption"
                where = f"{scene.name}: {called('medium', number, medium.name)}: {of}"
                notes[where] = (
                    f"{where} is known from {ends[0]:g} to {ends[1]:g} nm; its ends are held from {VISIBLE_NM[0]:g} to "
                    f"{VISIBLE_NM[1]:g}, which changes luminance by less than {BEYOND:g} % of white"
                )
    return list(notes.values())


class Amounts:
    """The amounts of matter that walkers count, and the exponents by wavelength and by channel of each.

    Parameters
    ----------
    weight : (k, 3) float64
        Of each wavelength in linear RGB; k = 0 where nothing is given by wavelength.
    """

    def __init__(self, weight: np.ndarray) -> None:
        self.weight = weight
        self._columns: list[tuple[np.ndarray, np.ndarray]] = []

    def add(self, by_wavelength: np.ndarray | None, by_channel: np.ndarray) -> int:
        """Return the number of one more amount, whose exponents (k,), None for zeros, and (3,) these are."""
        self._columns.append((np.zeros(len(self.weight)) if by_wavelength is None else by_wavelength, by_channel))
        return len(self._columns) - 1

    def arrays(self) -> Attenuation:
        """Return all of them for kernels."""
        count, wavelengths = len(self._columns), len(self.weight)
        spectral = np.array([column for column, _ in self._columns]).reshape(count, wavelengths)
        rgb = np.array([column for _, column in self._columns]).T.reshape(3, count)
        least = rgb.max(axis=0) + (spectral.max(axis=1) if wavelengths else 0.0)
        return Attenuation(*map(np.ascontiguousarray, (spectral, rgb, self.weight.T, least)))


class _Row(NamedTuple):
    """One medium, named as in `Media`; choice, scale, slot and g by component."""

    free: float
    reach: float
    travel: int
    choice: list[float]
    scale: list[float]
    slot: list[int]
    g: list[float]


def media_of(
    scene: Scene, traits: Traits, tables: Sequence[Table], limit: int
) -> tuple[Media, Attenuation, tuple[VolumeParameters, ...]]:
    """Return media, absorption and volume parameters, with amounts only for what absorbs.

    Parameters
    ----------
    scene : Scene
    traits : Traits
        Of the level.
    tables : sequence of Table
        Of the components, medium after medium.
    limit : int
        Grains met after which a path is given up.
    """
    spectra = [spectra_of(grain.absorption, scene.metres_per_unit) for m in scene.media for grain in m.grains]
    coloured = any(s.by_wavelength is not None for s in spectra)
    amounts = Amounts(image.spectral_weights().weight if coloured else np.zeros((0, 3)))
    rows: list[_Row] = []
    parameters: list[VolumeParameters] = []
    first = np.cumsum([0] + [len(medium.grains) for medium in scene.media])
    for medium, low, high in zip(scene.media, first[:-1], first[1:], strict=True):
        row, volume = _row(medium, traits, tables[low:high], spectra[low:high], amounts)
        rows.append(row)
        parameters.append(volume)
    media = Media(
        traits=traits,
        free=np.array([row.free for row in rows]),
        reach=np.array([row.reach for row in rows]),
        first=np.array(first[:-1], np.int64),
        kinds=np.array([len(row.slot) for row in rows], np.int64),
        travel=np.array([row.travel for row in rows], np.int64),
        choice=np.array([x for row in rows for x in row.choice]),
        scale=np.array([x for row in rows for x in row.scale]),
        slot=np.array([x for row in rows for x in row.slot], np.int64),
        g=np.array([x for row in rows for x in row.g]),
        limit=limit,
    )
    return media, amounts.arrays(), tuple(parameters)


def _row(
    medium: MediumSpec, traits: Traits, tables: Sequence[Table], spectra: Sequence[Spectra], amounts: Amounts
) -> tuple[_Row, VolumeParameters]:
    """Return one medium, whose components have these tables and spectra, and its volume parameters."""
    components = [
        Component(table, grain.fraction, medium.radius) for table, grain in zip(tables, medium.grains, strict=True)
    ]
    path = free_path(components, medium.packing_fraction)
    volume = volume_parameters(components, medium.packing_fraction, [s.grey(amounts.weight) for s in spectra])
    mean_cosine = volume.g if volume.albedo > 0.0 else 0.0  # where no light leaves a grain any will do
    if traits.similar:
        free = 1.0 / max(volume.sigma_t * (1.0 - mean_cosine), 1.0 / UNENDING)
    else:
        free = path.lambda_beta if traits.spheres else 1.0 / volume.sigma_t

    slots = []
    by_length = [np.zeros(len(amounts.weight)), np.zeros(3)]  # exponents of the length flown
    for table, absorption, probability in zip(tables, spectra, path.choice, strict=True):
        by_wavelength, by_channel = absorption
        if not absorption.absorbs:
            slots.append(-1)
        elif traits.points:
            kept = [_kept(table, medium.radius, s) for s in (np.zeros(0) if by_wavelength is None else by_wavelength,
                                                             by_channel)]  # fmt: skip
            slots.append(amounts.add(np.log(kept[0]) if by_wavelength is not None else None, np.log(kept[1])))
            for exponents, share in zip(by_length, kept, strict=True):
                if len(share):
                    exponents -= probability * volume.sigma_t * mean_cosine * (1.0 - share)
        else:
            slots.append(amounts.add(None if by_wavelength is None else -by_wavelength, -by_channel))
    flies = traits.similar and any(s.absorbs for s in spectra)
    row = _Row(
        free=free,
        reach=LONGEST_OFFSET * medium.radius if traits.jumps else 0.0,
        travel=amounts.add(by_length[0], by_length[1]) if flies else -1,
        choice=list(np.cumsum(path.choice)),
        scale=[1.0 if traits.points else medium.radius] * len(components),
        slot=slots,
        g=[mean_cosine] * len(components),
    )
    return row, volume


def _kept(table: Table, radius: float, sigma_a: np.ndarray) -> np.ndarray:
    """Return the share that a grain keeps of the light that it would keep without absorption, at each coefficient."""
    lossless = table.albedo()
    return np.array([max(table.albedo(s * radius) / lossless, DARKEST) for s in sigma_a])
