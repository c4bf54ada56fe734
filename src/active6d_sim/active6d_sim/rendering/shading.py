"""Colours of surface points: materials, prints, light with shadows, highlights and reflections."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from active6d_core.se3 import invert
from active6d_sim.rendering.appearance import TEXTURE_SIZE, Appearance
from active6d_sim.rendering.surface_print import SurfacePrint
from active6d_sim.rendering.triangle_soup import BACKDROP, FIRST_OBJECT, TABLE, TABLE_HALF_WIDTH, TRAY
from active6d_sim.scenes.scene import Scene

_FADE_START = 0.8
_TEXEL = 0.002
#: (4096,) linear light in [0, 1] to sRGB bytes.
_TO_SRGB = np.round(255 * np.linspace(0.0, 1.0, 4096) ** (1 / 2.2)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """p points that camera rays hit.

    Attributes:
        position: (p, 3) float32 world, metres.
        normal: (p, 3) float32 unit vectors, world; zero without surface.
        openness: (p,) ambient openness in [0, 1].
        material: (p,) int16 as in :class:`.TriangleSoup`, ``BACKDROP`` without surface.
        direction: (p, 3) float32 of the camera's rays, world, any length.
    """

    position: np.ndarray
    normal: np.ndarray
    openness: np.ndarray
    material: np.ndarray
    direction: np.ndarray


@dataclass(frozen=True, eq=False)
class ShadedPoints:
    """Shading of p points.

    Attributes:
        color: (p, 3) uint8 sRGB.
        albedo: (p,) float32 diffuse reflectance in [0, 1]; of a metal it is small.
        gloss: (p,) float32 strength of mirror-like reflection in [0, 1].
    """

    color: np.ndarray
    albedo: np.ndarray
    gloss: np.ndarray


class Shader:
    """Shades the points of one scene with one appearance.

    Args:
        scene: the scene.
        model_color: (3,) sRGB colour of the objects in their description.
        radius: largest distance of the objects' surface from their origin, metres; prints scale with it.
        appearance: colours, textures and lights.
        in_shadow: from (p, 3) points and a (3,) direction to (p,) bool, whether something is in that direction.
    """

    def __init__(
        self,
        scene: Scene,
        model_color: np.ndarray,
        radius: float,
        appearance: Appearance,
        in_shadow: Callable[[np.ndarray, np.ndarray], np.ndarray],
    ) -> None:
        self._scene, self._look, self._in_shadow = scene, appearance, in_shadow
        objects = len(scene.T_world_all)
        self._first_thing = FIRST_OBJECT + objects
        fixed = np.array([appearance.backdrop, appearance.table_color, appearance.bin_color], np.float32)
        palette = [fixed, appearance.instance_colors(objects, model_color)]
        poses, radii = [scene.T_world_all], [np.full(objects, radius)]
        if scene.surroundings is not None:
            palette.append(scene.surroundings.color.astype(np.float32))
            poses.append(scene.surroundings.T_world_thing)
            radii.append(np.linalg.norm(scene.surroundings.size, axis=1) / 2)
        self._palette = np.concatenate(palette)
        self._T_local_world = invert(np.concatenate(poses)).astype(np.float32)
        self._radius = np.concatenate(radii).astype(np.float32)

    def shade(self, points: SurfacePoints) -> ShadedPoints:
        """Ambient light with occlusion, a fill light, and a key light with hard shadows."""
        look = self._look
        key, fill = (_unit(direction) for direction in (look.key_direction, look.fill_direction))
        facing_key = points.normal @ key
        lit = np.flatnonzero((facing_key > 0) & (points.material != BACKDROP))
        lit = lit[~self._in_shadow(points.position[lit] + 5e-4 * points.normal[lit], key)]
        texture = self._texture(points)
        strengths = np.zeros((len(texture), 3), np.float32)
        strengths[lit, 0] = facing_key[lit] * texture[lit]
        texture *= points.openness
        strengths[:, 1] = texture * (0.75 + 0.25 * points.normal[:, 2])
        strengths[:, 2] = texture * np.maximum(points.normal @ fill, 0)
        light = strengths @ np.array([look.key_color, look.ambient_color, look.fill_color], np.float32)
        surface, gloss = self._surface(points)
        metal = self._metal(points.material)
        light *= surface if metal is None else surface * (1 - metal)[:, None]
        self._add_highlights(light, lit, points, key)
        if metal is not None:
            self._add_reflections(light, points, surface, metal)
        self._paint_backdrop(light, points)
        light *= len(_TO_SRGB) - 1
        color = _TO_SRGB[np.clip(light, 0, len(_TO_SRGB) - 1, out=light).astype(np.int16)]
        albedo = surface.mean(axis=1)
        return ShadedPoints(color, albedo if metal is None else albedo * (1 - 0.8 * metal), gloss)

    @cached_property
    def _textures(self) -> np.ndarray:
        """(2, texels) brightness factors of the table and of the tray."""
        return self._look.textures().reshape(2, -1)

    @cached_property
    def _prints(self) -> dict[int, SurfacePrint]:
        """The print of every printed material."""
        return self._look.prints(self._first_thing - FIRST_OBJECT, len(self._radius) + FIRST_OBJECT - self._first_thing)

    def _texture(self, points: SurfacePoints) -> np.ndarray:
        """(p,) brightness factor; walls take their texture along x + z and y + z, so that no UV map is needed."""
        factor = np.ones(len(points.material), np.float32)
        ground = np.flatnonzero((points.material == TABLE) | (points.material == TRAY))
        x, y, z = points.position[ground].T
        row, column = (((along + z) / _TEXEL).astype(np.int32) % TEXTURE_SIZE for along in (y, x))
        layer = (points.material[ground] == TRAY).astype(np.int32)
        factor[ground] = self._textures[layer, row * TEXTURE_SIZE + column]
        return factor

    def _surface(self, points: SurfacePoints) -> tuple[np.ndarray, np.ndarray]:
        """(p, 3) diffuse colour without light, and (p,) gloss."""
        colors = self._palette[points.material]
        for number, layers in self._prints.items():
            chosen = np.flatnonzero(points.material == FIRST_OBJECT + number)
            if len(chosen):
                T = self._T_local_world[number]
                local = (points.position[chosen] @ T[:3, :3].T + T[:3, 3]) / self._radius[number]
                colors[chosen] = layers.paint(local, colors[chosen])
        gloss = np.zeros(len(colors), np.float32)
        on_object = (points.material >= FIRST_OBJECT) & (points.material < self._first_thing)
        gloss[on_object] = min(self._look.shininess + self._look.metalness, 1.0)
        return colors, gloss

    def _metal(self, material: np.ndarray) -> np.ndarray | None:
        """(p,) share of the light that objects mirror like a metal; None where nothing does."""
        if self._look.metalness == 0:
            return None
        on_object = (material >= FIRST_OBJECT) & (material < self._first_thing)
        return np.where(on_object, np.float32(self._look.metalness), np.float32(0))

    def _add_highlights(self, light: np.ndarray, lit: np.ndarray, points: SurfacePoints, key: np.ndarray) -> None:
        """Add Blinn-Phong highlights of the key light on objects and things."""
        glossy = lit[points.material[lit] >= FIRST_OBJECT]
        view = -points.direction[glossy]
        half = view / np.linalg.norm(view, axis=1, keepdims=True) + key
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        facing = np.maximum(np.einsum("ij,ij->i", points.normal[glossy], half), 0)
        strength = self._look.shininess * facing**self._look.highlight_exponent
        light[glossy] += strength[:, None] * np.array(self._look.key_color, np.float32)

    def _add_reflections(
        self, light: np.ndarray, points: SurfacePoints, surface: np.ndarray, metal: np.ndarray
    ) -> None:
        """Add the mirror image of a room on metal: bright above, dark below, with a few lamps."""
        chosen = np.flatnonzero(metal > 0)
        ray, normal = points.direction[chosen], points.normal[chosen]
        ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        mirrored = ray - 2 * np.einsum("ij,ij->i", ray, normal)[:, None] * normal
        room = 0.25 + 0.35 * mirrored[:, 2]
        for lamp in self._look.lamps():
            room += 1.2 * np.exp(25 * (mirrored @ lamp - 1))
        light[chosen] += (metal[chosen] * np.maximum(room, 0.02) * points.openness[chosen])[:, None] * surface[chosen]

    def _paint_backdrop(self, light: np.ndarray, points: SurfacePoints) -> None:
        """Paint a plain backdrop, into which an endless table fades with distance."""
        backdrop = np.array(self._look.backdrop, np.float32)
        light[points.material == BACKDROP] = backdrop
        if self._scene.surroundings is not None:
            return
        table = np.flatnonzero(points.material == TABLE)
        away = np.hypot(points.position[table, 0], points.position[table, 1])
        far = away > _FADE_START
        fade = np.minimum((away[far] - _FADE_START) / (TABLE_HALF_WIDTH - _FADE_START), 1)[:, None]
        light[table[far]] += fade * (backdrop - light[table[far]])


def _unit(vector: tuple[float, float, float]) -> np.ndarray:
    return (np.array(vector) / np.linalg.norm(vector)).astype(np.float32)
