"""The hemisphere that the camera moves on, its grid of views, and distances along it (paper, supplement D)."""

from dataclasses import dataclass, field

import numpy as np

from active6d_core.se3 import look_at

_MOST_VIEWS = 100_000


@dataclass(frozen=True)
class ViewSphere:
    """Views on the upper hemisphere around the bin's centre, all facing it.

    Views are numbered ``elevation_index * azimuths + azimuth_index``.

    Attributes:
        radius: metres from the world's origin.
        elevations_degrees: levels of the grid, above the horizon.
        azimuths: number of evenly spaced azimuths, the first at world +x.

    Raises:
        ValueError: a radius or number that is not positive, too many views, or an elevation outside [0, 90].
    """

    radius: float = 0.8
    elevations_degrees: tuple[float, ...] = (15.0, 30.0, 45.0, 60.0, 75.0)
    azimuths: int = 20
    positions: np.ndarray = field(init=False, repr=False, compare=False)
    """(M, 3) camera positions in the world, metres."""

    def __post_init__(self) -> None:
        if not 0 < self.radius < np.inf or self.azimuths < 1 or not self.elevations_degrees:
            raise ValueError(f"view sphere: radius and number of views must be positive, got {self}")
        if self.azimuths * len(self.elevations_degrees) > _MOST_VIEWS:
            raise ValueError(f"view sphere: a grid has at most {_MOST_VIEWS} views")
        if not all(0 <= elevation <= 90 for elevation in self.elevations_degrees):
            raise ValueError(f"view sphere: elevations must be within [0, 90], got {self.elevations_degrees}")
        elevation, azimuth = np.meshgrid(
            np.radians(self.elevations_degrees),
            np.arange(self.azimuths) * 2 * np.pi / self.azimuths,
            indexing="ij",
        )
        object.__setattr__(self, "positions", self.position(azimuth.ravel(), elevation.ravel()))

    def __len__(self) -> int:
        return len(self.positions)

    def position(self, azimuth: np.ndarray, elevation: np.ndarray) -> np.ndarray:
        """Angles in radians (...,) to (..., 3) positions in metres on the sphere."""
        return self.radius * np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
        )

    def angles(self, position: np.ndarray) -> np.ndarray:
        """(..., 3) positions to (..., 2) azimuth in (-pi, pi] and elevation in [-pi/2, pi/2], radians."""
        x, y, z = np.moveaxis(np.asarray(position, float), -1, 0)
        return np.stack([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))], axis=-1)

    def pose(self, position: np.ndarray) -> np.ndarray:
        """``T_world_camera`` (4, 4) of the camera at (3,) ``position``, facing the world's origin."""
        return look_at(position, np.zeros(3))

    def arc(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Great-circle distance in metres between the directions of (..., 3) positions a and b."""
        (ax, ay, az), (bx, by, bz) = (np.moveaxis(np.asarray(each, float), -1, 0) for each in (a, b))
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        angle = np.arctan2(np.sqrt(x * x + y * y + z * z), ax * bx + ay * by + az * bz)
        return self.radius * angle

    def path_length(self, positions: np.ndarray) -> float:
        """Total arc in metres along (n, 3) positions in order: the paper's distance travelled d."""
        positions = np.asarray(positions, float)
        return float(self.arc(positions[:-1], positions[1:]).sum())

    def nearest(self, position: np.ndarray, allowed: np.ndarray | None = None) -> int:
        """Index of the grid view nearest to (3,) ``position`` among ``allowed`` ((M,) bool, all when None).

        Raises:
            ValueError: no view is allowed.
        """
        distance = self.arc(self.positions, position)
        if allowed is not None:
            if not np.any(allowed):
                raise ValueError("no view of the grid is allowed")
            distance = np.where(allowed, distance, np.inf)
        return int(np.argmin(distance))
