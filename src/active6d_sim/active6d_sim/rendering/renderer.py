"""Registered colour, depth, instance and normal images of a scene, by ray casting (Open3D's Embree).

Everything in the scene is one triangle soup. What does not depend on the camera (ambient occlusion, textures, the
instances' colours) is computed once per scene, when the first colour image is asked for. A view then costs one primary
ray and at most one shadow ray per pixel.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import open3d as o3d

from active6d_core.camera import DEFAULT_CAMERA, PinholeCamera, pixel_rays
from active6d_core.object_model import ObjectModel, load_object
from active6d_core.view_sphere import ViewSphere
from active6d_sim.rendering.appearance import Appearance
from active6d_sim.rendering.shading import Shader, SurfacePoints
from active6d_sim.rendering.triangle_soup import (
    BACKDROP,
    FIRST_OBJECT,
    TRAY,
    TriangleSoup,
    build_soup,
)
from active6d_sim.scenes.scene import Scene

_OCCLUSION_RAYS = 48
_OCCLUSION_REACH = 0.25


@dataclass(frozen=True, eq=False)
class RenderedView:
    """Images of a noise-free camera.

    Attributes:
        color: (H, W, 3) uint8 RGB; None where shading was not asked for.
        depth: (H, W) float32 metres along z, NaN without surface.
        instance: (H, W) int16 index into ``Scene.T_world_all`` (ground truth's objects first), -1 elsewhere.
        normals: (H, W, 3) float32 unit surface normals in the camera frame, smooth over curved surfaces, facing the
            camera; zero without surface.
        albedo: (H, W) float32 diffuse reflectance in [0, 1], 0 without surface; None without colour.
        gloss: (H, W) float32 strength of mirror-like reflection in [0, 1], 0 without surface; None without colour.
    """

    color: np.ndarray | None
    depth: np.ndarray
    instance: np.ndarray
    normals: np.ndarray
    albedo: np.ndarray | None = None
    gloss: np.ndarray | None = None

    def reflectance(self) -> tuple[np.ndarray, np.ndarray]:
        """Albedo and gloss.

        Raises:
            ValueError: the view was rendered without colour.
        """
        if self.albedo is None or self.gloss is None:
            raise ValueError("the view was rendered without colour")
        return self.albedo, self.gloss


class SceneRenderer:
    """Renders one scene from any camera.

    Args:
        scene: the scene to render.
        model: its object; loaded by the scene's ``object_name`` when None.
        appearance: colours and lights; when None the default one, or one of the scene's own if it has surroundings.
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
        self._threads = threads
        self._soup = soup = build_soup(self.model.mesh, scene)
        self._caster = o3d.t.geometry.RaycastingScene(nthreads=threads)
        self._caster.add_triangles(soup.vertices, soup.faces)
        # The last row is for rays that hit nothing.
        self._corner_normals = np.concatenate([soup.normals[soup.faces], np.zeros((1, 3, 3), np.float32)])
        self._face_normals = np.ascontiguousarray(self._corner_normals[:, 0])
        self._material = np.append(soup.material, np.int16(BACKDROP))
        self._first_thing = FIRST_OBJECT + len(scene.T_world_all)
        self.dress(appearance or default_appearance(scene, appearance_seed))

    def dress(self, appearance: Appearance) -> None:
        """Change colours and lights of the views that follow; the geometry stays."""
        radius = float(np.linalg.norm(self.model.mesh.vertices, axis=1).max())
        self._shader = Shader(self.scene, self.model.color, radius, appearance, self._in_shadow)

    def _in_shadow(self, points: np.ndarray, towards: np.ndarray) -> np.ndarray:
        rays = _rays(points, np.broadcast_to(towards, points.shape))
        return self._caster.test_occlusions(rays, nthreads=self._threads).numpy()

    def render(
        self,
        T_world_camera: np.ndarray,
        camera: PinholeCamera = DEFAULT_CAMERA,
        *,
        shaded: bool = True,
    ) -> RenderedView:
        """One noise-free view.

        Args:
            T_world_camera: (4, 4) pose of the optical frame.
            camera: intrinsics of all images.
            shaded: whether to render the colour image, which takes most of the time.
        """
        R = np.asarray(T_world_camera[:3, :3], np.float32)
        eye = np.asarray(T_world_camera[:3, 3], np.float32)
        directions = pixel_rays(camera).reshape(-1, 3) @ R.T
        depth, face, uv = self._cast(eye, directions)
        hit = np.isfinite(depth)
        points = eye + directions * np.where(hit, depth, 0)[:, None]
        material = self._material[face]
        solid = np.flatnonzero(material >= FIRST_OBJECT)
        weights = _barycentric(uv)
        normals = self._interpolate_normals(face, weights, solid)
        away = solid[np.einsum("ij,ij->i", normals[solid], directions[solid]) > 0]
        normals[away] *= -1
        shape = (camera.height, camera.width)
        color = albedo = gloss = None
        if shaded:
            openness = np.einsum("ij,ij->i", weights, self._openness[face])
            shading = self._shader.shade(SurfacePoints(points, normals, openness, material, directions))
            color = shading.color.reshape(*shape, 3)
            albedo, gloss = np.where(hit, shading.albedo, 0).reshape(shape), shading.gloss.reshape(shape)
        return RenderedView(
            color,
            np.where(hit, depth, np.float32(np.nan)).reshape(shape),
            self._instance(material).astype(np.int16).reshape(shape),
            (normals @ R).reshape(*shape, 3),
            albedo,
            gloss,
        )

    def _instance(self, material: np.ndarray) -> np.ndarray:
        """Index of the object of each material, -1 for others."""
        return np.where((material >= FIRST_OBJECT) & (material < self._first_thing), material - FIRST_OBJECT, -1)

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
        directions, first = directions[first >= TRAY], self._instance(first[first >= TRAY].astype(int))
        crossings = self._caster.list_intersections(_rays(eye, directions), nthreads=self._threads)
        crossed = self._instance(self._material[crossings["primitive_ids"].numpy()].astype(int))
        silhouettes = np.zeros((count, len(directions)), bool)
        silhouettes[crossed[crossed >= 0], crossings["ray_ids"].numpy()[crossed >= 0]] = True
        return np.bincount(first[first >= 0], minlength=count), silhouettes.sum(axis=1)

    def sees(self, eye: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(p,) bool, whether (p, 3) ``points`` on surfaces are visible from (3,) ``eye``; all in the world, metres."""
        directions = (points - eye).astype(np.float32)
        # A hit at parameter 1 is the point itself; 0.1 % are allowed for rounding.
        return self._cast(eye.astype(np.float32), directions)[0] > 0.999

    def surface_height(self, xy: np.ndarray) -> np.ndarray:
        """(p,) world z of the highest surface at (p, 2) world x and y, metres; ``-inf`` beside everything."""
        above = np.column_stack([xy, np.full(len(xy), 10.0)]).astype(np.float32)
        return above[:, 2] - self._cast(above, np.broadcast_to(np.array([0, 0, -1], np.float32), above.shape))[0]

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

    def _interpolate_normals(self, face: np.ndarray, weights: np.ndarray, solid: np.ndarray) -> np.ndarray:
        """(p, 3) unit normals at barycentric (p, 3) ``weights`` of the faces, smooth for the ``solid`` rays."""
        normals = self._face_normals[face]
        smooth = np.einsum("ij,ijk->ik", weights[solid], self._corner_normals[face[solid]])
        smooth /= np.maximum(np.sqrt(np.einsum("ij,ij->i", smooth, smooth)), 1e-6)[:, None]
        normals[solid] = smooth
        return normals


def default_appearance(scene: Scene, seed: int) -> Appearance:
    """The default colours and lights of a bin on an empty table; random ones, by its seed, of a wild scene."""
    if scene.surroundings is None:
        return Appearance(seed=seed)
    return Appearance.wild(np.random.default_rng([scene.seed, seed, 3]))


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


def _ambient_openness(caster: o3d.t.geometry.RaycastingScene, soup: TriangleSoup, threads: int) -> np.ndarray:
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
