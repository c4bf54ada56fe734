"""The view grid and distances on it against spherical trigonometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from active6d_core.se3 import invert, is_rigid, transform_points
from active6d_core.view_sphere import ViewSphere

SPHERE = ViewSphere()
azimuths = st.floats(-np.pi + 1e-6, np.pi)
elevations = st.floats(0.0, 1.5)


def test_the_grid_is_the_papers():
    """Supplement D: 5 elevations and 20 azimuths on a hemisphere of 80 cm."""
    assert len(SPHERE) == 100
    np.testing.assert_allclose(np.linalg.norm(SPHERE.positions, axis=1), 0.8)
    angles = np.degrees(SPHERE.angles(SPHERE.positions)).reshape(5, 20, 2)
    np.testing.assert_allclose(angles[..., 1], np.repeat([[15], [30], [45], [60], [75]], 20, axis=1))
    np.testing.assert_allclose(np.mod(angles[..., 0], 360.0), np.tile(np.arange(0, 360, 18.0), (5, 1)), atol=1e-9)


@given(azimuths, elevations)
def test_angles_undo_position(azimuth, elevation):
    np.testing.assert_allclose(SPHERE.angles(SPHERE.position(azimuth, elevation)), [azimuth, elevation], atol=1e-9)


@given(azimuths, elevations, azimuths, elevations)
def test_arc_is_the_haversine_formula(azimuth_a, elevation_a, azimuth_b, elevation_b):
    a, b = SPHERE.position(azimuth_a, elevation_a), SPHERE.position(azimuth_b, elevation_b)
    haversine = (
        np.sin((elevation_b - elevation_a) / 2) ** 2
        + np.cos(elevation_a) * np.cos(elevation_b) * np.sin((azimuth_b - azimuth_a) / 2) ** 2
    )
    expected = 0.8 * 2 * np.arcsin(np.sqrt(min(1.0, haversine)))
    assert SPHERE.arc(a, b) == pytest.approx(expected, abs=1e-7)
    assert SPHERE.arc(3.0 * a, b) == pytest.approx(float(SPHERE.arc(a, b)), abs=1e-12)


def test_path_length_adds_arcs_and_is_zero_for_one_view():
    path = SPHERE.positions[[0, 5, 10, 99]]
    assert SPHERE.path_length(path) == pytest.approx(sum(SPHERE.arc(path[i], path[i + 1]) for i in range(3)))
    assert SPHERE.path_length(path[:1]) == 0.0


@given(azimuths, elevations)
def test_a_camera_faces_the_bin(azimuth, elevation):
    position = SPHERE.position(azimuth, elevation)
    T_world_camera = SPHERE.pose(position)
    assert is_rigid(T_world_camera)
    np.testing.assert_allclose(T_world_camera[:3, 3], position)
    np.testing.assert_allclose(transform_points(invert(T_world_camera), np.zeros((1, 3)))[0], [0, 0, 0.8], atol=1e-9)


@given(azimuths, elevations, st.integers(0, 2**32 - 1))
def test_nearest_is_the_nearest_allowed(azimuth, elevation, seed):
    position = SPHERE.position(azimuth, elevation)
    allowed = np.random.default_rng(seed).random(100) < 0.1
    allowed[seed % 100] = True
    chosen = SPHERE.nearest(position, allowed)
    assert allowed[chosen]
    chords = np.linalg.norm(SPHERE.positions - position, axis=1)
    assert chords[chosen] <= chords[allowed].min() + 1e-9
    assert chords[SPHERE.nearest(position)] <= chords.min() + 1e-9


def test_nearest_of_nothing_is_an_error():
    with pytest.raises(ValueError, match="no view"):
        SPHERE.nearest(SPHERE.positions[0], np.zeros(100, bool))


def test_spheres_with_equal_grids_are_equal():
    assert ViewSphere() == SPHERE
    assert ViewSphere(radius=0.5) != SPHERE
    assert len({ViewSphere(), SPHERE}) == 1


@pytest.mark.parametrize(
    "wrong",
    [{"radius": 0.0}, {"radius": np.nan}, {"azimuths": 0}, {"elevations_degrees": ()}, {"elevations_degrees": (-5.0,)}],
)
def test_a_sphere_without_views_or_below_the_table_is_refused(wrong):
    with pytest.raises(ValueError, match="view sphere"):
        ViewSphere(**wrong)
