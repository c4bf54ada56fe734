"""Registered colour, depth, instance and normal images of a scene, by ray casting (Open3D's Embree).

Everything in the scene is one triangle soup. What does not depend on the camera (ambient occlusion, textures, the
instances' colours) is computed once per scene, when the first colour image is asked for. A view then costs one primary
ray and at most one shadow ray per pixel.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import open3d as o3d
import trimesh
from numpy.typing import ArrayLike

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera, pixel_rays
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.se3 import invert, transform_points
from active6d_core.view_sphere import ViewSphere
from active6d_sim.rendering.appearance import TEXTURE_SIZE, Appearance
from active6d_sim.scenes.scene import Bin, Scene

_TABLE_HALF_WIDTH = 2.5
_FADE_START = 0.8
_TEXEL = 0.002
_SHARP_EDGE = np.radians(40.0)
_OCCLUSION_RAYS = 48
_OCCLUSION_REACH = 0.25
#: (4096,) linear light in [0, 1] to sRGB bytes.
_TO_SRGB = np.round(255 * np.linspace(0.0, 1.0, 4096) ** (1 / 2.2)).astype(np.uint8)

_BACKDROP, _TABLE, _TRAY, _FIRST_INSTANCE = range(4)


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Images of a noise-free camera.

    Attributes:
        color: (H, W, 3) uint8 RGB; None where shading was not asked for.
        depth: (H, W) float32 metres along z, NaN without surface.
        instance: (H, W) int16 index into ``Scene.T_world_all`` (ground truth's objects first), -1 elsewhere.
        normals: (H, W, 3) float32 unit surface normals in the camera frame, smooth over curved surfaces, facing the
            camera; zero without surface.
        object_coordinates: (H, W, 3) float32 surface points in the frame of the pixel's object, metres, zero elsewhere;
            None where they were not asked for.
    """

    color: np.ndarray | None
    depth: np.ndarray
    instance: np.ndarray
    normals: np.ndarray
    object_coordinates: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class _Soup:
    """All triangles of a scene.

    Attributes:
        vertices: (v, 3) float32, world.
        normals: (v, 3) float32 unit normals, world.
        faces: (f, 3) uint32.
        material: (f,) int16, ``_TABLE``, ``_TRAY`` or ``_FIRST_INSTANCE + instance``.
    """

    vertices: np.ndarray
    normals: np.ndarray
    faces: np.ndarray
    material: np.ndarray


class SceneRenderer:
    """Renders one scene from any camera.

    Args:
        scene: the scene to render.
        model: its object; loaded by the scene's ``object_name`` when None.
        appearance: colours and lights; the default appearance when None.
        appearance_seed: seed of tints and textures if ``appearance`` is None.
        threads: number of threads of the ray caster, 0 for one per core.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        model: ObjectModel | None = None,
        appearance: Appearance | None = None,
        appearance_seed: int = 0,
        threads: int = 0,
    ) -> None:
        self.scene = scene
        self.model = model or load_object(scene.object_name)
        self._look = appearance or Appearance(seed=appearance_seed)
        self._threads = threads
        self._T_object_world = invert(scene.T_world_all).astype(np.float32)
        self._soup = soup = _build_soup(self.model.mesh, scene)
        self._caster = o3d.t.geometry.RaycastingScene(nthreads=threads)
        self._caster.add_triangles(soup.vertices, soup.faces)
        # The last row is for rays that hit nothing.
        self._corner_normals = np.concatenate([soup.normals[soup.faces], np.zeros((1, 3, 3), np.float32)])
        self._face_normals = np.ascontiguousarray(self._corner_normals[:, 0])
        self._material = np.append(soup.material, np.int16(_BACKDROP))

    def render(
        self,
        T_world_camera: np.ndarray,
        camera: PinholeCamera = DEFAULT_CAMERA,
        *,
        shaded: bool = True,
        object_coordinates: bool = False,
    ) -> RenderedView:
        """One noise-free view.

        Args:
            T_world_camera: (4, 4) pose of the optical frame.
            camera: intrinsics of all images.
            shaded: whether to render the colour image, which takes most of the time.
            object_coordinates: whether to render the image of that name.
        """
        R = np.asarray(T_world_camera[:3, :3], np.float32)
        eye = np.asarray(T_world_camera[:3, 3], np.float32)
        directions = pixel_rays(camera).reshape(-1, 3) @ R.T
        depth, face, uv = self._cast(eye, directions)
        hit = np.isfinite(depth)
        points = eye + directions * np.where(hit, depth, 0)[:, None]
        material = self._material[face]
        on_object = np.flatnonzero(material >= _FIRST_INSTANCE)
        weights = _barycentric(uv)
        normals = self._interpolate_normals(face, weights, on_object)
        away = on_object[np.einsum("ij,ij->i", normals[on_object], directions[on_object]) > 0]
        normals[away] *= -1
        shape = (camera.height, camera.width)
        color = None
        if shaded:
            openness = np.einsum("ij,ij->i", weights, self._openness[face])
            color = self._shade(points, normals, openness, material, directions).reshape(*shape, 3)
        coordinates = None
        if object_coordinates:
            T = self._T_object_world[material[on_object] - _FIRST_INSTANCE]
            coordinates = np.zeros_like(points)
            coordinates[on_object] = np.einsum("pij,pj->pi", T[:, :3, :3], points[on_object]) + T[:, :3, 3]
            coordinates = coordinates.reshape(*shape, 3)
        return RenderedView(
            color,
            np.where(hit, depth, np.float32(np.nan)).reshape(shape),
            np.maximum(material - _FIRST_INSTANCE, -1).astype(np.int16).reshape(shape),
            (normals @ R).reshape(*shape, 3),
            coordinates,
        )

    def instance_layers(self, T_world_camera: np.ndarray, camera: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
        """Count the pixels of each object: those that are visible, and those if it were rendered alone.

        Args:
            T_world_camera: (4, 4) pose of the optical frame.
            camera: intrinsics.

        Returns:
            (n + h,) numbers of visible pixels, and (n + h,) numbers of pixels of the whole silhouettes in the image.
        """
        count = len(self.scene.T_world_all)
        directions = pixel_rays(camera).reshape(-1, 3) @ np.asarray(T_world_camera[:3, :3], np.float32).T
        eye = np.asarray(T_world_camera[:3, 3], np.float32)
        first = self._material[self._cast(eye, directions)[1]]
        # Nothing lies behind the table or the backdrop, so a ray that reaches them has met no object.
        directions, first = directions[first >= _TRAY], first[first >= _TRAY].astype(int) - _FIRST_INSTANCE
        crossings = self._caster.list_intersections(_rays(eye, directions), nthreads=self._threads)
        crossed = self._material[crossings["primitive_ids"].numpy()].astype(int) - _FIRST_INSTANCE
        silhouettes = np.zeros((count, len(directions)), bool)
        silhouettes[crossed[crossed >= 0], crossings["ray_ids"].numpy()[crossed >= 0]] = True
        return np.bincount(first[first >= 0], minlength=count), silhouettes.sum(axis=1)

    def sees(self, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(p,) bool, whether (p, 3) ``points`` on surfaces are visible from (3,) ``eye``; all in the world, metres."""
        directions = (points - eye).astype(np.float32)
        # A hit at parameter 1 is the point itself; 0.1 % are allowed for rounding.
        return self._cast(eye.astype(np.float32), directions)[0] > 0.999

    def _cast(self, eye: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(p,) ray parameter, (p,) face and (p, 2) barycentric coordinates of first hits; misses get the extra face.

        For directions with z = 1 in the camera frame, the ray parameter is the depth.
        """
        answer = self._caster.cast_rays(_rays(eye, directions), nthreads=self._threads)
        face = np.minimum(answer["primitive_ids"].numpy(), len(self._material) - 1)
        return answer["t_hit"].numpy(), face, answer["primitive_uvs"].numpy()

    @cached_property
    def _openness(self) -> np.ndarray:
        """(f + 1, 3) ambient openness at the corners of the faces."""
        openness = _ambient_openness(self._caster, self._soup, self._threads)
        return np.concatenate([openness[self._soup.faces], np.zeros((1, 3), np.float32)])

    @cached_property
    def _textures(self) -> np.ndarray:
        """(2, texels) brightness factors of the table and of the tray."""
        return self._look.textures().reshape(2, -1)

    @cached_property
    def _palette(self) -> np.ndarray:
        """(materials, 3) linear colour of each material."""
        fixed = np.array([self._look.backdrop, self._look.table_color, self._look.bin_color], np.float32)
        instances = self._look.instance_colors(len(self.scene.T_world_all), self.model.color)
        return np.concatenate([fixed, instances])

    def _interpolate_normals(self, face: np.ndarray, weights: np.ndarray, on_object: np.ndarray) -> np.ndarray:
        """(p, 3) unit normals at barycentric (p, 3) ``weights`` of the faces, smooth for the rays ``on_object``."""
        normals = self._face_normals[face]
        smooth = np.einsum("ij,ijk->ik", weights[on_object], self._corner_normals[face[on_object]])
        smooth /= np.maximum(np.sqrt(np.einsum("ij,ij->i", smooth, smooth)), 1e-6)[:, None]
        normals[on_object] = smooth
        return normals

    def _shade(
        self,
        points: np.ndarray,
        normals: np.ndarray,
        openness: np.ndarray,
        material: np.ndarray,
        directions: np.ndarray,
    ) -> np.ndarray:
        """(p, 3) uint8 sRGB from ambient light with occlusion, a fill light, and a key light with hard shadows."""
        look = self._look
        key, fill = (_unit(direction) for direction in (look.key_direction, look.fill_direction))
        facing_key = normals @ key
        lit = np.flatnonzero((facing_key > 0) & (material != _BACKDROP))
        offset = points[lit] + 5e-4 * normals[lit]
        towards_key = _rays(offset, np.broadcast_to(key, offset.shape))
        lit = lit[~self._caster.test_occlusions(towards_key, nthreads=self._threads).numpy()]
        texture = self._texture(points, material)
        strengths = np.zeros((len(points), 3), np.float32)
        strengths[lit, 0] = facing_key[lit] * texture[lit]
        texture *= openness
        strengths[:, 1] = texture * (0.75 + 0.25 * normals[:, 2])
        strengths[:, 2] = texture * np.maximum(normals @ fill, 0)
        light = strengths @ np.array([look.key_color, look.ambient_color, look.fill_color], np.float32)
        light *= self._palette[material]
        self._add_highlights(light, lit, normals, material, directions, key)
        self._paint_backdrop(light, points, material, directions)
        light *= len(_TO_SRGB) - 1
        return _TO_SRGB[np.minimum(light, len(_TO_SRGB) - 1, out=light).astype(np.int16)]

    def _texture(self, points: np.ndarray, material: np.ndarray) -> np.ndarray:
        """(p,) brightness factor; walls take their texture along x + z and y + z, so that no UV map is needed."""
        factor = np.ones(len(points), np.float32)
        ground = np.flatnonzero((material == _TABLE) | (material == _TRAY))
        x, y, z = points[ground].T
        row, column = (((along + z) / _TEXEL).astype(np.int32) % TEXTURE_SIZE for along in (y, x))
        layer = (material[ground] == _TRAY).astype(np.int32)
        factor[ground] = self._textures[layer, row * TEXTURE_SIZE + column]
        return factor

    def _add_highlights(
        self,
        light: np.ndarray,
        lit: np.ndarray,
        normals: np.ndarray,
        material: np.ndarray,
        directions: np.ndarray,
        key: np.ndarray,
    ) -> None:
        """Add Blinn-Phong highlights of the key light on objects."""
        glossy = lit[material[lit] >= _FIRST_INSTANCE]
        view = -directions[glossy]
        half = view / np.linalg.norm(view, axis=1, keepdims=True) + key
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        strength = self._look.shininess * np.maximum(np.einsum("ij,ij->i", normals[glossy], half), 0) ** 48
        light[glossy] += strength[:, None] * np.array(self._look.key_color, np.float32)

    def _paint_backdrop(
        self, light: np.ndarray, points: np.ndarray, material: np.ndarray, directions: np.ndarray
    ) -> None:
        """Paint a plain backdrop, into which the table fades with distance."""
        backdrop = np.array(self._look.backdrop, np.float32)
        light[material == _BACKDROP] = backdrop
        table = np.flatnonzero(material == _TABLE)
        away = np.hypot(points[table, 0], points[table, 1])
        far = away > _FADE_START
        fade = np.minimum((away[far] - _FADE_START) / (_TABLE_HALF_WIDTH - _FADE_START), 1)[:, None]
        light[table[far]] += fade * (backdrop - light[table[far]])


def visible_fractions(
    scene: Scene,
    model: ObjectModel | None = None,
    *,
    sphere: ViewSphere = ViewSphere(),
    camera: PinholeCamera = DEFAULT_CAMERA.scaled(0.25),
) -> np.ndarray:
    """(M, n + h) visible share of each object's silhouette from each of the M views of ``sphere``, in [0, 1].

    The share is the number of visible pixels over that of the object rendered alone, and 0 for objects outside of the
    image. A small image is enough: at 160x120 pixels a mug covers about 250 of them.
    """
    renderer = SceneRenderer(scene, model=model)
    layers = [renderer.instance_layers(sphere.pose(position), camera) for position in sphere.positions]
    visible, whole = (np.array(counts, float).reshape(len(sphere), -1) for counts in zip(*layers, strict=True))
    return np.divide(visible, whole, out=np.zeros_like(visible), where=whole > 0)


def _barycentric(uv: np.ndarray) -> np.ndarray:
    """(p, 3) weights of a triangle's corners from the ray caster's (p, 2) coordinates."""
    weights = np.empty((len(uv), 3), np.float32)
    weights[:, 1:] = uv
    weights[:, 0] = 1 - uv[:, 0] - uv[:, 1]
    return weights


def _rays(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3] = origins
    rays[:, 3:] = directions
    return rays


def _unit(vector: tuple[float, float, float]) -> np.ndarray:
    return (np.array(vector) / np.linalg.norm(vector)).astype(np.float32)


def _build_soup(mesh: trimesh.Trimesh, scene: Scene) -> _Soup:
    smooth = trimesh.graph.smooth_shade(mesh, angle=_SHARP_EDGE)
    vertices, normals, faces = np.asarray(smooth.vertices), np.asarray(smooth.vertex_normals), np.asarray(smooth.faces)
    parts = [_table(scene.bin), *_tray(scene.bin)]
    kinds = [_TABLE] + [_TRAY] * (len(parts) - 1)
    for T in scene.T_world_all:
        parts.append((transform_points(T, vertices), normals @ T[:3, :3].T, faces))
        kinds.append(len(kinds) - len(_tray(scene.bin)) - 1 + _FIRST_INSTANCE)
    offsets = np.cumsum([0] + [len(part[0]) for part in parts])
    return _Soup(
        np.concatenate([part[0] for part in parts]).astype(np.float32),
        np.concatenate([part[1] for part in parts]).astype(np.float32),
        np.concatenate([part[2] + offset for part, offset in zip(parts, offsets[:-1], strict=True)]).astype(np.uint32),
        np.repeat(np.array(kinds, np.int16), [len(part[2]) for part in parts]),
    )


def _patch(
    origin: ArrayLike, along_u: ArrayLike, along_v: ArrayLike, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A rectangle of quads at fractions ``rows`` and ``columns`` of its sides; its normal is u x v."""
    origin, along_u, along_v = (np.array(value, float) for value in (origin, along_u, along_v))
    v, u = np.meshgrid(rows, columns, indexing="ij")
    vertices = origin + u.reshape(-1, 1) * along_u + v.reshape(-1, 1) * along_v
    corner = (np.arange(len(rows) - 1)[:, None] * len(columns) + np.arange(len(columns) - 1)).ravel()
    right, above, across = corner + 1, corner + len(columns), corner + len(columns) + 1
    faces = np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, above], 1)])
    normal = np.cross(along_u, along_v)
    return vertices, np.broadcast_to(normal / np.linalg.norm(normal), vertices.shape), faces


def _table(bin: Bin) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The table; its mesh is fine near the bin, where ambient occlusion changes."""
    reach = min(1.5 * max(bin.inner_width, bin.inner_depth) / _TABLE_HALF_WIDTH, 0.9)
    lines = np.concatenate([[0.0], 0.5 + 0.5 * reach * np.linspace(-1, 1, 64), [1.0]])
    width = 2 * _TABLE_HALF_WIDTH
    return _patch((-width / 2, -width / 2, -bin.wall_thickness), (width, 0, 0), (0, width, 0), lines, lines)


def _tray(bin: Bin) -> list:
    """The bin's floor, and the inside, outside and rim of each of its four walls."""
    half_x, half_y, thick, top = bin.inner_width / 2, bin.inner_depth / 2, bin.wall_thickness, bin.wall_height
    fine, coarse, single = np.linspace(0, 1, 48), np.linspace(0, 1, 10), np.linspace(0, 1, 2)
    patches = [_patch((-half_x, -half_y, 0), (2 * half_x, 0, 0), (0, 2 * half_y, 0), fine, fine)]
    corners = np.array([[-half_x, -half_y], [half_x, -half_y], [half_x, half_y], [-half_x, half_y]])
    outward = np.sign(corners) * thick
    for start, end in ((0, 1), (1, 2), (2, 3), (3, 0)):
        inner_a, inner_b = corners[start], corners[end]
        outer_a, outer_b = inner_a + outward[start], inner_b + outward[end]
        inside, outside = np.append(inner_b - inner_a, 0), np.append(outer_b - outer_a, 0)
        if top > 0:
            patches.append(_patch((*inner_b, 0), -inside, (0, 0, top), coarse, fine))
        patches.append(_patch((*outer_a, -thick), outside, (0, 0, top + thick), coarse, fine))
        rim_width = np.append(np.sign(inner_a + inner_b) * thick, 0)
        patches.append(_patch((*outer_a, top), outside, -rim_width, single, fine))
    return patches


def _ambient_openness(caster: o3d.t.geometry.RaycastingScene, soup: _Soup, threads: int) -> np.ndarray:
    """(v,) cosine-weighted share of the hemisphere above each vertex that is free within ``_OCCLUSION_REACH``."""
    rng = np.random.default_rng(0)
    sphere = rng.normal(size=(_OCCLUSION_RAYS, 3)).astype(np.float32)
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    # A unit normal plus a point on the unit sphere is cosine-distributed about the normal.
    directions = soup.normals[:, None] + 0.99 * sphere
    origins = np.repeat(soup.vertices + 1e-3 * soup.normals, _OCCLUSION_RAYS, axis=0)
    directions /= np.linalg.norm(directions, axis=2, keepdims=True)
    distance = caster.cast_rays(_rays(origins, directions.reshape(-1, 3)), nthreads=threads)["t_hit"].numpy()
    free = np.clip(distance / _OCCLUSION_REACH, 0, 1).reshape(-1, _OCCLUSION_RAYS)
    return free.mean(axis=1).astype(np.float32)
