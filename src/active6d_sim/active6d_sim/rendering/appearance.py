"""Appearance of a scene: colours, textures and lights."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from active6d_sim.rendering.surface_print import SurfacePrint, random_colors

TEXTURE_SIZE = 512


@dataclass(frozen=True)
class Appearance:
    """Colours, textures and lights of a scene.

    Colours are linear RGB in [0, 1]. Directions point from the scene to the light, in the world, with any length.

    Attributes:
        object_color: of all instances; the model's colour when None.
        color_variation: relative standard deviation of tint and brightness between instances.
        shininess: strength of highlights on objects; 0 is matt.
        bin_color: colour of the bin.
        table_color: mean colour of the table.
        table_contrast: relative standard deviation of the table's texture.
        grain: smoothness of the table's texture in both directions, texels of 2 mm; unequal numbers look like wood.
        key_direction: direction of the light that casts shadows.
        key_color: colour of that light times its strength.
        fill_direction: direction of a second light without shadows.
        fill_color: colour of that light times its strength.
        ambient_color: colour of ambient light, which is weaker in crevices.
        backdrop: colour above the horizon.
        highlight_exponent: sharpness of highlights on objects.
        metalness: share of the light that objects mirror, tinted by their colour; 0 for paint, plastic and paper.
        printed: share of the things that have prints; all objects have the same print, unless it is 0.
        seed: seed of the instances' tints, the textures and the prints.
    """

    object_color: tuple[float, float, float] | None = None
    color_variation: float = 0.06
    shininess: float = 0.25
    bin_color: tuple[float, float, float] = (0.10, 0.15, 0.22)
    table_color: tuple[float, float, float] = (0.46, 0.31, 0.19)
    table_contrast: float = 0.14
    grain: tuple[float, float] = (1.2, 60.0)
    key_direction: tuple[float, float, float] = (0.45, -0.55, 1.0)
    key_color: tuple[float, float, float] = (0.95, 0.90, 0.82)
    fill_direction: tuple[float, float, float] = (-0.7, 0.5, 0.5)
    fill_color: tuple[float, float, float] = (0.13, 0.16, 0.20)
    ambient_color: tuple[float, float, float] = (0.34, 0.36, 0.40)
    backdrop: tuple[float, float, float] = (0.62, 0.67, 0.72)
    highlight_exponent: float = 48.0
    metalness: float = 0.0
    printed: float = 0.0
    seed: int = 0

    @classmethod
    def random(cls, rng: np.random.Generator, vary_object_color: float = 0.15) -> "Appearance":
        """Random lights, colours and textures, for training data.

        Args:
            rng: random generator.
            vary_object_color: relative deviation of the objects' hue and brightness from the model's colour.
        """
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(25, 85))
        key = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
        strength, warmth = rng.uniform(0.4, 1.4), rng.uniform(-0.15, 0.15)
        return cls(
            color_variation=rng.uniform(0.0, 0.12) + vary_object_color * rng.uniform(0.0, 1.0),
            shininess=rng.uniform(0.0, 0.6),
            bin_color=tuple(rng.uniform(0.02, 0.8, 3)),
            table_color=tuple(rng.uniform(0.05, 0.8, 3)),
            table_contrast=rng.uniform(0.0, 0.4),
            grain=tuple(np.exp(rng.uniform(np.log(0.8), np.log(60.0), 2))),
            key_direction=key,
            key_color=tuple(strength * np.array([1 + warmth, 1.0, 1 - warmth])),
            fill_direction=tuple(rng.normal(size=2)) + (0.5,),
            fill_color=tuple(rng.uniform(0.0, 0.3, 3)),
            ambient_color=tuple(rng.uniform(0.15, 0.5) * rng.uniform(0.85, 1.15, 3)),
            backdrop=tuple(rng.uniform(0.1, 0.9, 3)),
            seed=int(rng.integers(2**31)),
        )

    @classmethod
    def wild(cls, rng: np.random.Generator) -> "Appearance":
        """Random lights, any colours, prints, and surfaces from matt to metal, for training data and wild scenes."""
        plain = cls.random(rng)
        return replace(
            plain,
            object_color=_random_color(rng) if rng.random() < 0.75 else None,
            bin_color=_random_color(rng),
            table_color=_random_color(rng),
            grain=tuple(np.exp(rng.uniform(np.log(0.8), np.log(12.0), 2))),
            shininess=rng.uniform(0.0, 0.9) ** 2,
            highlight_exponent=float(np.exp(rng.uniform(np.log(8.0), np.log(200.0)))),
            metalness=rng.uniform(0.4, 1.0) if rng.random() < 0.15 else 0.0,
            printed=rng.uniform(0.2, 0.8) if rng.random() < 0.75 else 0.0,
        )

    def prints(self, objects: int, things: int) -> dict[int, SurfacePrint]:
        """Prints by index, of ``objects`` objects and of the ``things`` after them; all objects have the same."""
        rng = np.random.default_rng([self.seed, 4])
        if self.printed == 0:
            return {}
        own = SurfacePrint.random(rng)
        of_things = np.flatnonzero(rng.random(things) < self.printed)
        return dict.fromkeys(range(objects), own) | {objects + int(i): SurfacePrint.random(rng) for i in of_things}

    def lamps(self) -> np.ndarray:
        """(4, 3) float32 unit directions of lamps that metal mirrors."""
        directions = np.random.default_rng([self.seed, 5]).normal(size=(4, 3)) + (0.0, 0.0, 0.7)
        return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)

    def instance_colors(self, count: int, model_color: np.ndarray) -> np.ndarray:
        """(count, 3) float32 linear colour of each instance; ``model_color`` is sRGB as in the object's description."""
        rng = np.random.default_rng([self.seed, 1])
        base = np.array(model_color) ** 2.2 if self.object_color is None else np.array(self.object_color)
        brightness = 1 + self.color_variation * rng.normal(size=(count, 1))
        tint = 1 + 0.5 * self.color_variation * rng.normal(size=(count, 3))
        return np.clip(base * brightness * tint, 0.01, 1.0).astype(np.float32)

    def textures(self) -> np.ndarray:
        """(2, TEXTURE_SIZE, TEXTURE_SIZE) float32 tileable brightness factors: the table's grain, the bin's speckle."""
        rng = np.random.default_rng([self.seed, 2])
        table = sum(_tiling_noise(rng, np.multiply(self.grain, scale)) * weight for scale, weight in ((1, 1), (4, 0.7)))
        bin_speckle = 0.04 * _tiling_noise(rng, (1.0, 1.0))
        factors = np.stack([1 + self.table_contrast * table / 1.22, 1 + bin_speckle])
        return np.clip(factors, 0.2, 1.8).astype(np.float32)


def _random_color(rng: np.random.Generator) -> tuple[float, float, float]:
    red, green, blue = random_colors(rng, 1)[0].tolist()
    return red, green, blue


def _tiling_noise(rng: np.random.Generator, sigma: ArrayLike) -> np.ndarray:
    noise = gaussian_filter(rng.normal(size=(TEXTURE_SIZE, TEXTURE_SIZE)).astype(np.float32), sigma, mode="wrap")
    return noise / noise.std()
