"""What walkers share: the colour that is left of light, against numpy's exponentials."""

import math

import numpy as np
import pytest

from tsdf.picture.image import spectral_weights
from tsdf.walk.walker import Attenuation, absorbed, power


def test_exponentials() -> None:
    """To 1e-12 from exp(-200) to exp(200), to 3e-12 a hundred beyond; next to nothing, and finite, farther below."""
    x = np.concatenate((np.linspace(-300.0, 300.0, 2001), -np.geomspace(1e-300, 1.0, 200), [0.0]))
    found = np.array([power(v) for v in x])
    off = np.abs(found / np.exp(x) - 1.0)
    assert off[np.abs(x) <= 200.0].max() < 1e-12 and off.max() < 3e-12
    assert power(0.0) == 1.0
    assert 0.0 <= power(-1e6) < 1e-300 and power(-math.inf) < 1e-300


@pytest.mark.slow
@pytest.mark.parametrize("amounts", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.02, 1.5, 0.7), (40.0, 0.0, 9.0)])
def test_colour_that_is_left(amounts: tuple[float, ...]) -> None:
    """The sum over wavelengths and channels as it is written down; nothing crossed is white, exactly."""
    rng = np.random.default_rng(0)
    weight = spectral_weights().weight
    spectral, rgb = -rng.exponential(1.0, (3, len(weight))), -rng.exponential(1.0, (3, 3))
    absorption = Attenuation(spectral, rgb, np.ascontiguousarray(weight.T), np.zeros(3))
    found = absorbed(absorption, np.array(amounts), np.zeros(len(weight)))
    expected = (np.exp(np.array(amounts) @ spectral) @ weight) * np.exp(rgb @ amounts)
    assert np.abs(found / expected - 1.0).max() < 1e-10
    assert any(amounts) or found == (1.0, 1.0, 1.0)
    nothing = absorbed(
        absorption._replace(spectral=np.zeros((3, 0)), weight=np.zeros((3, 0))), np.array(amounts), np.zeros(0)
    )
    assert np.abs(nothing / np.exp(rgb @ amounts) - 1.0).max() < 1e-12
