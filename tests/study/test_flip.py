"""HDR-FLIP: against the numbers of the authors' own program, and what the definition implies."""

import numpy as np
import pytest

from tsdf.errors import UsageError
from tsdf.study import flip


def pictures() -> tuple[np.ndarray, np.ndarray]:
    """Waves that grow to the right over five octaves, and the same with a chequered fifth more and less."""
    y, x = np.mgrid[0:48, 0:64].astype(float)
    waves = np.stack([1 + np.sin(x / 5) + 0 * y, 0.5 + 0.4 * np.cos(y / 7), 0.3 + 0.2 * np.sin((x + y) / 9)], axis=2)
    one = waves * np.exp((x - 32) / 20)[..., None]
    return one, one * (1 + 0.2 * np.where((x // 3 + y // 3) % 2, 1, -1)[..., None])


# From flip-evaluator 1.7, the authors' program, on these pictures in float32: its defaults, 0.7 m and ACES
PUBLISHED = {"hdr": 0.1019241437, "ldr": 0.0903520882, "shifted": 0.3157435357}
UNIFORM = {(0.5, 0.6, 0.5): 0.3372286856, (0.5, 0.5, 0.7): 0.3543636203, (1.0, 0.0, 0.0): 0.9594751000}


def test_it_is_what_the_authors_program_gives() -> None:
    """To 3e-4 of uniform pictures, whose colours that program converts with rounded matrices, and to 1e-4 of others."""
    one, other = pictures()
    assert flip.hdr_flip(one, other) == pytest.approx(PUBLISHED["hdr"], rel=1e-4)
    dim = [np.clip(picture / 4, 0, 1) for picture in (one, other)]
    assert flip.ldr_flip(*dim).mean() == pytest.approx(PUBLISHED["ldr"], rel=1e-4)
    assert flip.ldr_flip(dim[0], np.roll(dim[0], 2, axis=1)).mean() == pytest.approx(PUBLISHED["shifted"], rel=1e-4)
    grey = np.full((20, 20, 3), 0.5)
    for colour, value in UNIFORM.items():
        assert flip.ldr_flip(grey, np.full(grey.shape, colour)).mean() == pytest.approx(value, rel=3e-4)


def test_equal_pictures_do_not_differ_and_more_is_more() -> None:
    """Nothing is 0, the picture against itself at half the error is less than at the whole, black on white is 1."""
    one, other = pictures()
    assert flip.hdr_flip(one, one) == 0.0
    assert 0.0 < flip.hdr_flip(one, 0.5 * (one + other)) < flip.hdr_flip(one, other) < 1.0
    black, white = np.zeros((20, 20, 3)), np.ones((20, 20, 3))
    assert flip.ldr_flip(black, white) == pytest.approx(flip.ldr_flip(white, black))
    assert flip.ldr_flip(black, white).mean() > 0.9


def test_exposures_do_not_depend_on_the_unit_of_light() -> None:
    one, other = pictures()
    start, stop = flip.exposures(one)
    assert np.array(flip.exposures(8.0 * one)) == pytest.approx([start - 3.0, stop - 3.0])
    assert flip.hdr_flip(8.0 * one, 8.0 * other) == pytest.approx(flip.hdr_flip(one, other))
    white = flip.tone_mapped(np.array([2.0**start * (one @ flip.LUMINANCE).max()]))
    assert white == pytest.approx(flip.BRIGHT)


def test_pictures_that_cannot_be_compared() -> None:
    one, _ = pictures()
    for reference, test, word in ((one, one[:, 1:], "size"), (np.zeros_like(one), one, "black")):
        with pytest.raises(UsageError, match=word):
            flip.hdr_flip(reference, test)
