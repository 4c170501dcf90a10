"""Packings: spheres that do not overlap and lie as fluids and glasses do; lines through them against brute force."""

import io
import math
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from numba import njit
from scipy.spatial import cKDTree
from scipy.special import sph_harm_y

from tsdf import archive
from tsdf.errors import UsageError
from tsdf.spheres import packing as module
from tsdf.spheres.packing import MAX, Cells, Packing, cells_of, next_sphere, pack

EXTRA_SEEDS = (1, 2)  # of the densest fluid, whose pairs are counted


@pytest.fixture(scope="module")
def packings() -> dict[float, Packing]:
    return {f: pack(f, 1500, cache=False) for f in (0.1, 0.3, 0.6)} | {0.45: pack(0.45, 2000, cache=False)}


def pairs(centres: np.ndarray, side: float, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs of centres nearer than `apart` and the vectors between them, images included."""
    found = cKDTree(centres, boxsize=side).query_pairs(apart, output_type="ndarray")
    vectors = centres[found[:, 0]] - centres[found[:, 1]]
    return found, vectors - side * np.round(vectors / side)


def fcc(fraction: float, noise: float) -> tuple[np.ndarray, float]:
    """Return 2048 sites of the face-centred cubic crystal, each moved a little, and the side of their cube."""
    side = (2048 * 4.0 / 3.0 * math.pi / fraction) ** (1.0 / 3.0)
    base = np.array([[0.0, 0.0, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5], [0.5, 0.5, 0.0]])
    sites = (np.array(list(product(range(8), repeat=3)))[:, None] + base).reshape(-1, 3) * side / 8
    return (sites + noise * np.random.default_rng(0).normal(size=sites.shape)) % side, side


# ------------------------------------------------------------------------------------------ the packing


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [1e-4, 0.2, 0.5, 0.625, MAX])
def test_spheres_do_not_overlap(fraction: float) -> None:
    """All pairs with all images by plain arithmetic; the fraction is the one asked for, the bytes are repeated."""
    packing = pack(fraction, 200, seed=3, cache=False)
    centres, side = packing.centres, packing.side
    assert centres.shape == (200, 3) and centres.dtype == np.float64 and not centres.flags.writeable
    assert centres.min() >= 0.0 and centres.max() < side
    assert packing.fraction == pytest.approx(fraction, rel=1e-12) and packing.seed == 3
    assert 200 * 4.0 / 3.0 * math.pi / side**3 == pytest.approx(fraction, rel=1e-12)
    least = math.inf
    for tile in product((-1, 0, 1), repeat=3):
        distance = np.linalg.norm(centres[:, None] - centres[None] + side * np.array(tile), axis=2)
        least = min(least, distance[distance > 0.0].min())
    assert least >= 2.0 - 1e-9
    if fraction in (0.2, MAX):
        assert pack(fraction, 200, seed=3, cache=False).centres.tobytes() == centres.tobytes()
        assert pack(fraction, 200, seed=4, cache=False).centres.tobytes() != centres.tobytes()


def contact_value(packings: list[tuple[np.ndarray, float]]) -> tuple[float, float]:
    """Return g(2R) extrapolated from pairs up to 2.2 R apart, and its standard error from the counts of pairs."""
    edges = np.linspace(2.0, 2.2, 9)
    count, ideal = np.zeros(8), np.zeros(8)
    for centres, side in packings:
        _, vectors = pairs(centres, side, 2.2)
        count += np.histogram(np.linalg.norm(vectors, axis=1), edges)[0]
        ideal += len(centres) ** 2 / 2 / side**3 * 4.0 / 3.0 * math.pi * np.diff(edges**3)
    beyond = 0.5 * (edges[1:] + edges[:-1]) - 2.0
    coefficients, covariance = np.polyfit(beyond, np.log(count / ideal), 2, w=np.sqrt(count), cov="unscaled")
    value = math.exp(coefficients[-1])
    return value, value * math.sqrt(covariance[-1, -1])


@pytest.mark.slow
def test_dense_fluid_has_the_contacts_of_the_equilibrium(packings: dict[float, Packing]) -> None:
    """g(2R) is Carnahan & Starling's (1969) within 4 standard errors at f = 0.45, and these are within 3 %.

    Control: spheres only pushed apart, never stirred, are found out; so is a theory at a fraction off by 0.03.
    """

    def theory(f: float) -> float:
        return (1.0 - f / 2.0) / (1.0 - f) ** 3

    fluids = [packings[0.45], *(pack(0.45, 2000, seed, cache=False) for seed in EXTRA_SEEDS)]
    value, error = contact_value([(p.centres, p.side) for p in fluids])
    assert error < 0.03 * value
    assert abs(value - theory(0.45)) < 4.0 * error
    assert abs(value - theory(0.48)) > 4.0 * error
    side = fluids[0].side
    raw = side * np.random.default_rng(0).random((2000, 3))
    assert module._relax(raw, side, 10, 2.0001, 2.0, 10_000)
    value, error = contact_value([(raw, side)])
    assert abs(value - theory(0.45)) > 4.0 * error


@pytest.mark.slow
def test_thin_fluid_has_room_for_one_more_as_the_equilibrium_has(packings: dict[float, Packing]) -> None:
    """The share of points where a further sphere fits is exp(-mu), mu the excess potential of Carnahan & Starling.

    The standard error is that of 64 blocks of the cube, as nearby points share their spheres. Control: Poisson points.
    """

    def room(centres: np.ndarray, side: float) -> tuple[float, float]:
        points = np.random.default_rng(1).random((64, 2000, 3)) + np.array(list(product(range(4), repeat=3)))[:, None]
        fits = cKDTree(centres, boxsize=side).query(points.reshape(-1, 3) * side / 4)[0] >= 2.0
        blocks = fits.reshape(64, -1).mean(axis=1)
        return blocks.mean(), blocks.std(ddof=1) / 8.0

    f = 0.1
    theory = math.exp(-(8.0 * f - 9.0 * f**2 + 3.0 * f**3) / (1.0 - f) ** 3)
    value, error = room(packings[f].centres, packings[f].side)
    assert abs(value - theory) < 4.0 * error < 0.1 * theory
    poisson, error = room(packings[f].side * np.random.default_rng(2).random((1500, 3)), packings[f].side)
    assert abs(poisson - theory) > 4.0 * error


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.3, 0.45])
def test_density_is_even(packings: dict[float, Packing], fraction: float) -> None:
    """The structure factor of the 13 longest waves is the compressibility of Carnahan & Starling, not that of chance.

    Each wave's is exponentially distributed, so their mean has a relative standard error of 13^-1/2. Control: Poisson.
    """
    f = fraction
    theory = (1.0 - f) ** 4 / ((1.0 + 2.0 * f) ** 2 + f**3 * (f - 4.0))
    waves = np.array([k for k in product((-1, 0, 1), repeat=3) if k > (0, 0, 0)])

    def structure(places: np.ndarray) -> float:
        return float((abs(np.exp(2j * math.pi * places @ waves.T).sum(axis=0)) ** 2).mean() / len(places))

    highest = theory * (1.0 + 4.0 / math.sqrt(13))
    assert structure(packings[f].centres / packings[f].side) < highest
    assert structure(np.random.default_rng(0).random((1500, 3))) > highest


def order(centres: np.ndarray, side: float) -> tuple[float, float, float]:
    """Return Q6 sqrt(bonds) (Steinhardt et al. 1983), the share of solid-like spheres, and a stretch of the pairs.

    Solid-like is a sphere with seven neighbours or more whose bonds correlate with its own (ten Wolde et al. 1996); the
    stretch is the largest deviation, in standard errors, of the mean square of a bond's component from a third.
    """
    found, vectors = pairs(centres, side, 2.8)
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    theta, phi = np.arccos(np.clip(unit[:, 2], -1.0, 1.0)), np.arctan2(unit[:, 1], unit[:, 0])
    harmonics = np.array([sph_harm_y(6, m, theta, phi) for m in range(-6, 7)])
    q6 = math.sqrt(4.0 * math.pi / 13.0 * (abs(harmonics.mean(axis=1)) ** 2).sum() * len(found))
    own = np.zeros((13, len(centres)), complex)
    for end in found.T:
        np.add.at(own.T, end, harmonics.T)
    own /= np.linalg.norm(own, axis=0)
    alike = (own[:, found[:, 0]] * own[:, found[:, 1]].conj()).sum(axis=0).real > 0.7
    friends = np.bincount(found[alike].ravel(), minlength=len(centres))
    stretch = abs((unit**2).mean(axis=0) - 1.0 / 3.0).max() / ((unit**2).std() / math.sqrt(len(found)))
    return q6, float((friends >= 7).mean()), stretch


@pytest.mark.slow
def test_dense_packing_is_no_crystal(packings: dict[float, Packing]) -> None:
    """At 0.6 no bond order in the large, hardly a solid-like sphere, no neighbours at 2 sqrt 2 R, no preferred axis.

    Q6 sqrt(bonds) is 1 for independent bonds and sqrt(bonds) / 2 = 55 for a crystal; some units leave room for the
    correlation of bonds that share a sphere. Controls: a shaken crystal, half a cube of it, a stretched cube.
    """
    glass = packings[0.6]
    q6, solid, stretch = order(glass.centres, glass.side)
    assert q6 < 5.0 and solid < 0.02 and stretch < 4.0
    crystal, side = fcc(0.6, 0.1)
    q6, solid, _ = order(crystal, side)
    assert q6 > 5.0 and solid > 0.02
    half = np.concatenate([crystal[crystal[:, 0] < side / 2], glass.centres[glass.centres[:, 0] > side / 2]])
    q6, solid, _ = order(half % side, side)
    assert q6 > 5.0 and solid > 0.02
    assert order(glass.centres * [1.0, 1.0, 0.95], glass.side)[2] > 4.0

    def second_shell(centres: np.ndarray, side: float) -> float:  # at the second neighbours of the crystal, and around
        distance = np.linalg.norm(pairs(centres, side, 3.4)[1], axis=1)
        a = 4.0 * (math.pi / math.sqrt(18.0) / 0.6) ** (1.0 / 3.0) / math.sqrt(2.0)
        count, *_ = np.histogram(distance, [a - 0.4, a - 0.2, a + 0.2, a + 0.4])
        return float(count[1] / (count[0] + count[2]))

    assert second_shell(glass.centres, glass.side) < 1.2 < second_shell(crystal, side)


@pytest.mark.slow
@pytest.mark.parametrize(("spheres", "seed"), [(64, 0), (64, 1), (300, 2)])
def test_densest_packing_is_made_of_any_number(spheres: int, seed: int) -> None:
    """At MAX, where random starts jam, fluids are compressed; some starts of few spheres jam, and others follow."""
    packing = pack(MAX, spheres, seed, cache=False)
    assert module.closest(packing.centres, packing.side) >= 2.0 - 1e-9
    assert packing.fraction == pytest.approx(MAX, rel=1e-12)


@pytest.mark.slow
def test_densest_packing_is_no_crystal(packings: dict[float, Packing]) -> None:
    """Nor is the compressed fluid at 0.64, by the same measures, whose controls are those of the test above.

    Pairs up to 2.2 R apart are more than at 0.6, by less than a fifth: the same neighbours, closer together.
    """
    packing = pack(MAX, 500, cache=False)
    q6, solid, stretch = order(packing.centres, packing.side)
    assert q6 < 5.0 and solid < 0.05 and stretch < 4.0
    share = [2.0 * len(pairs(p.centres, p.side, 2.2)[0]) / len(p.centres) for p in (packings[0.6], packing)]
    assert 1.0 < share[1] / share[0] < 1.2


# ------------------------------------------------------------------------------------------ lines


@njit
def walk(cells, origin, direction, t_max, distances, places):  # type: ignore[no-untyped-def]
    """Write the spheres entered up to t_max, each call beginning where the last one ended; return how many."""
    t, n = 0.0, 0
    while n < len(distances):
        t, i, j, k, sphere = next_sphere(cells, origin, direction, t, t_max)
        if sphere < 0:
            break
        distances[n] = t
        places[n, 0], places[n, 1], places[n, 2], places[n, 3] = i, j, k, sphere
        n += 1
    return n


def walked(cells: Cells, origin: np.ndarray, direction: np.ndarray, t_max: float) -> tuple[np.ndarray, np.ndarray]:
    distances, places = np.empty(1000), np.empty((1000, 4), np.int64)
    n = walk(cells, tuple(map(float, origin)), tuple(map(float, direction)), t_max, distances, places)
    assert n < 1000
    return distances[:n], places[:n]


def brute(packing: Packing, origin: np.ndarray, d: np.ndarray, t_max: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the same as `walked` from the quadratic equation of every image that is anywhere near."""
    base = np.floor(origin / packing.side)
    local = origin - base * packing.side
    ends = np.stack([local, local + t_max * d])
    low = np.floor((ends.min(axis=0) - 1.5) / packing.side).astype(int)
    high = np.floor((ends.max(axis=0) + 1.5) / packing.side).astype(int)
    tiles = np.array(list(product(*(range(a, b + 1) for a, b in zip(low, high, strict=True)))))
    offset = (packing.centres[None] + packing.side * tiles[:, None]).reshape(-1, 3) - local
    along = offset @ d
    discriminant = along**2 - (offset**2).sum(axis=1) + 1.0
    t = along - np.sqrt(discriminant.clip(min=0.0))
    met = np.flatnonzero((discriminant > 0.0) & (t > 0.0) & (t <= t_max))
    met = met[np.argsort(t[met])]
    tile, sphere = np.divmod(met, len(packing.centres))
    return t[met], np.column_stack([tiles[tile] + base.astype(int), sphere])


def rays(packing: Packing, kind: str, number: int) -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(5)
    origins, directions = packing.side * rng.random((number, 3)), rng.normal(size=(number, 3))
    if kind == "negative":
        origins -= 7.3 * packing.side
    elif kind == "far":
        origins += rng.choice([-1e6, 1e6], (number, 3))
    elif kind == "axis":
        directions = np.eye(3)[rng.integers(3, size=number)] * rng.choice([-1.0, 1.0], (number, 1))
        directions[::2] *= -1.0  # some zeros are negative
    elif kind == "plane":
        directions[np.arange(number), rng.integers(3, size=number)] = 0.0
    elif kind == "nearly":
        directions *= np.where(rng.random((number, 3)) < 0.5, 10.0 ** rng.uniform(-320, -6, (number, 3)), 1.0)
    elif kind == "borders":  # along and into the planes between cells and tiles
        m = cells_of(packing).m
        origins = rng.integers(-m, 2 * m, (number, 3)) * packing.side / m
        directions = rng.integers(-1, 2, (number, 3)) + 0.0
    keep = np.linalg.norm(directions, axis=1) > 1e-3
    directions = directions[keep] / np.linalg.norm(directions[keep], axis=1, keepdims=True)
    return list(zip(origins[keep], directions, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.02, 0.3, 0.6])
@pytest.mark.parametrize("kind", ["random", "negative", "far", "axis", "plane", "nearly", "borders"])
def test_walk_meets_what_brute_force_meets(fraction: float, kind: str) -> None:
    """Every sphere along a ray, its tile and its distance, in order, whatever the ray and however wide the cells.

    Grazed spheres (chords under 1e-3) may be in one list only, as rounding decides.
    """
    packing = pack(fraction, 100, cache=False)
    for edge in (None, 0.7, 3.0):
        cells = cells_of(packing, edge)
        total = 0
        for origin, direction in rays(packing, kind, 60):
            t, places = walked(cells, origin, direction, 50.0)
            expected_t, expected = brute(packing, origin, direction, 50.0)
            total += len(t)
            if not np.array_equal(places, expected):
                odd = {tuple(p) for p in places} ^ {tuple(p) for p in expected}
                for *tile, sphere in odd:
                    offset = packing.centres[sphere] + packing.side * np.array(tile) - origin
                    assert abs(np.linalg.norm(np.cross(offset, direction)) - 1.0) < 1e-6
                common = [i for i, p in enumerate(places) if tuple(p) not in odd]
                t = t[common]
                expected_t = expected_t[[i for i, p in enumerate(expected) if tuple(p) not in odd]]
            assert np.allclose(t, expected_t, rtol=0.0, atol=1e-6 if kind == "far" else 1e-9)
        assert total > 20


@pytest.mark.slow
def test_limits_of_the_interval() -> None:
    """t_min is left out, t_max is in, a sphere around the origin is skipped, nothing found is infinity and -1."""
    packing = pack(0.3, 100, cache=False)
    cells, d = cells_of(packing), (0.6, 0.0, 0.8)
    none = (math.inf, 0, 0, 0, -1)
    inside = tuple(map(float, packing.centres[7]))
    t, i, j, k, sphere = next_sphere(cells, inside, d, 0.0, math.inf)
    assert t > 0.0 and (i, j, k, sphere) != (0, 0, 0, 7)
    assert next_sphere(cells, inside, d, -5.0, math.inf) == (t, i, j, k, sphere)
    assert next_sphere(cells, inside, d, 0.0, t) == (t, i, j, k, sphere)
    assert next_sphere(cells, inside, d, 0.0, np.nextafter(t, 0.0)) == none
    assert next_sphere(cells, inside, d, np.nextafter(t, 0.0), t) == (t, i, j, k, sphere)
    assert next_sphere(cells, inside, d, t, math.inf)[0] > t
    assert next_sphere(cells, inside, d, t, t) == next_sphere(cells, inside, d, 5.0, 3.0) == none


def test_rays_that_meet_nothing_end() -> None:
    """Between the spheres of a cubic lattice a ray goes on for ever, and the search does not; nor for nonsense."""
    centres = 4.0 * np.array(list(product(range(4), repeat=3))) + 2.0
    cells = cells_of(Packing(centres, 16.0, 64 * 4.0 / 3.0 * math.pi / 16.0**3, 0))
    none = (math.inf, 0, 0, 0, -1)
    assert next_sphere(cells, (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), 0.0, math.inf) == none
    assert next_sphere(cells, (2.0, 0.0, 2.0), (0.0, -1.0, 0.0), 0.0, math.inf) == (1.0, 0, -1, 0, 3 * 4)
    for bad in (math.nan, math.inf, 1e300):
        for place in range(3):
            triple = tuple(bad if axis == place else 0.25 for axis in range(3))
            next_sphere(cells, triple, (0.0, -1.0, 0.0), 0.0, math.inf)
            next_sphere(cells, (0.0, 0.0, 0.0), triple, 0.0, math.inf)
        next_sphere(cells, (0.0, 0.0, 0.0), (0.6, 0.0, 0.8), bad, math.inf)
        next_sphere(cells, (0.0, 0.0, 0.0), (0.6, 0.0, 0.8), 0.0, bad)


@pytest.mark.slow
@pytest.mark.parametrize("fraction", [0.1, 0.3, 0.6])
def test_mean_gap_between_spheres(packings: dict[float, Packing], fraction: float) -> None:
    """The mean chord of the void is 4 (1 - f) / (3 f), an exact theorem of any packing, within 4 standard errors.

    Entries and lengths in spheres are counted over windows of fixed length, which biases neither; lines are isotropic.
    Control: a fraction off by six hundredths of itself is rejected.
    """
    packing, length = packings[fraction], 60.0
    cells, rng = cells_of(packing), np.random.default_rng(11)
    number = 4000
    origins, directions = packing.side * rng.random((number, 3)), rng.normal(size=(number, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    entries, void = np.empty(number), np.empty(number)
    for line, (origin, d) in enumerate(zip(origins, directions, strict=True)):
        t, places = walked(cells, origin, d, length)
        offset = packing.centres[places[:, 3]] + packing.side * places[:, :3] - origin
        assert np.all(np.diff(t) > 0.0)
        entries[line], void[line] = len(t), length - 2.0 * (offset @ d - t).sum()
    gap = void.sum() / entries.sum()
    error = (void - gap * entries).std() / entries.mean() / math.sqrt(number)
    assert abs(gap - 4.0 * (1.0 - fraction) / (3.0 * fraction)) < 4.0 * error
    off = 0.94 * fraction
    assert abs(gap - 4.0 * (1.0 - off) / (3.0 * off)) > 4.0 * error


# ------------------------------------------------------------------------------------------ keeping, refusing


@pytest.mark.slow
def test_cache_keeps_and_heals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is kept is taken; what is damaged, another packing's or no packing at all is made anew, in silence."""
    monkeypatch.setenv("TSDF_CACHE", str(tmp_path / "new" / "folder"))
    packing = pack(0.3, 64)
    (file,) = (tmp_path / "new" / "folder").iterdir()
    whole = file.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(module, "_made", None)
        assert pack(0.3, 64).centres.tobytes() == packing.centres.tobytes()
        with pytest.raises(TypeError):  # it would have to be made
            pack(0.3, 64, seed=1)
        with pytest.raises(TypeError):
            pack(0.3, 64, cache=False)
    pack(0.3, 64, seed=1)
    (other,) = set(file.parent.iterdir()) - {file}
    damaged = bytearray(whole)
    damaged[len(whole) // 2] ^= 1
    overlapping = packing.centres.copy()
    overlapping[0] = overlapping[1]
    foreign = archive.read(other, 10_000)["centres"]  # a packing, but of another seed
    grown = io.BytesIO()
    np.savez_compressed(grown, centres=np.zeros((10**6, 3)), name=np.array(file.stem))
    for wrong in (b"", whole[:-100], bytes(damaged), b"PK" + b"\0" * 500, other.read_bytes(), grown.getvalue()):
        file.write_bytes(wrong)
        assert pack(0.3, 64).centres.tobytes() == packing.centres.tobytes()
        assert file.read_bytes() == whole
    np.savez(file, centres=foreign, name=np.array(file.stem))
    assert pack(0.3, 64).centres.tobytes() == packing.centres.tobytes()
    for centres in (packing.centres[:5], overlapping, packing.centres.astype(np.float32)):
        archive.write(file, {"centres": centres, "name": np.array(file.stem)})
        assert pack(0.3, 64).centres.tobytes() == packing.centres.tobytes()
        assert file.read_bytes() == whole


def test_cache_that_cannot_be_written_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("TSDF_CACHE", str(tmp_path / "file" / "below"))
    assert len(pack(0.1, 64).centres) == 64


def test_place_of_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """TSDF_CACHE, else tsdf in XDG_CACHE_HOME if that is an absolute path as its rules ask, else in ~/.cache."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.delenv("TSDF_CACHE", raising=False)
    for value, folder in ((str(tmp_path / "xdg"), "xdg/tsdf"), ("relative", ".cache/tsdf"), ("", ".cache/tsdf")):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert module.cache_folder() == tmp_path / folder


@pytest.mark.parametrize("fraction", [0.0, -0.1, 0.6401, 1.0, math.nan, math.inf])
def test_impossible_fractions_are_refused(fraction: float) -> None:
    with pytest.raises(UsageError, match="packing fraction must be above 0 and at most"):
        pack(fraction)


@pytest.mark.parametrize(("spheres", "seed"), [(63, 0), (100.5, 0), (0, 0), (math.inf, 0), (100, -1), (100, 2**64)])
def test_impossible_numbers_are_refused(spheres: int, seed: int) -> None:
    with pytest.raises(UsageError, match=r"spheres, 64 or more|whole number in"):
        pack(0.3, spheres, seed)
