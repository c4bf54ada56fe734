"""Estimators to compare with: OpenCV's point pair features, and Open3D's FPFH with RANSAC.

Both libraries align one model with one point cloud. Finding many instances needs more: the bin is removed, candidates
are taken from the whole scene, and a pose is accepted only if the depth image agrees with it. These parts are those of
our own estimators, so that the comparison is about proposing and refining poses.
"""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
import open3d as o3d

from active6d_core.camera import View
from active6d_core.hypotheses import Hypotheses
from active6d_core.object_model import ObjectModel
from active6d_core.se3 import invert, make_transform
from active6d_perception.estimators.geometric.foreground import Surface, measure_surface
from active6d_perception.estimators.masks import claim_pixels
from active6d_perception.estimators.pose_evidence import NEAR, OCCLUDED, VIOLATED, weigh_poses
from active6d_perception.estimators.pose_selection import judge_of
from active6d_perception.estimators.registry import Estimator
from active6d_perception.model.model_views import model_views
from active6d_perception.model.symmetric_distance import SymmetricDistance
from active6d_perception.suppression import suppress

_REGISTRATION = o3d.pipelines.registration
_FEWEST_POINTS = 50


class DepthCheck:
    """Accepts poses that agree with the depth image: most unoccluded surface is measured, little is seen through."""

    def __init__(self, model: ObjectModel, *, min_fit: float = 0.5, max_violated: float = 0.12) -> None:
        """
        Args:
            model: the object.
            min_fit: least share of a pose's visible surface, what others hide left out, measured where it should be.
            max_violated: largest share of it that the camera looked through.
        """
        self._model, self._min_fit, self._max_violated = model, min_fit, max_violated
        self._views, self._judge = model_views(model), judge_of(model, samples=512)
        self._distance = SymmetricDistance(model)

    def report(self, T_camera_object: np.ndarray, surface: Surface, view: View) -> Hypotheses:
        """The accepted ones of (k, 4, 4) candidates, without duplicates, scored by the share of surface that fits."""
        evidence = weigh_poses(T_camera_object, self._judge, surface.image)
        fitting, violated = evidence[:, NEAR], evidence[:, VIOLATED]
        open_to_view = np.maximum(1.0 - evidence[:, OCCLUDED], 1e-6)
        accepted = np.flatnonzero(
            (fitting >= self._min_fit * open_to_view)
            & (violated <= self._max_violated * open_to_view)
            & (fitting >= 0.1)
        )
        poses = T_camera_object[accepted]
        score = np.clip(fitting - violated, 0.0, 1.0)[accepted]
        kept = suppress(self._distance.between(poses, poses), score, 0.15 * self._model.diameter)
        poses, score = poses[kept], score[kept]
        label = claim_pixels(self._views, poses, surface.image.points, surface.foreground, view.camera)
        claimed = np.unique(label[label > 0])
        if not len(claimed):
            return Hypotheses.empty(view.camera.height, view.camera.width)
        index = claimed.astype(np.intp) - 1
        relabel = np.zeros(len(poses) + 1, np.uint16)
        relabel[claimed] = np.arange(1, len(claimed) + 1)
        return Hypotheses.from_masks(poses[index], score[index], relabel[claimed], relabel[label], view.depth)


class VisibleIcp:
    """Open3D's point-to-plane ICP with the half of the model that faces the camera: the far side of a thin wall would
    be pulled onto the near side's measurements."""

    def __init__(self, model: ObjectModel, spacing: float, gates: tuple[float, ...] = (0.020, 0.010, 0.005)) -> None:
        """
        Args:
            model: the object.
            spacing: metres between its points.
            gates: metres, the largest correspondence distance of each stage.
        """
        self._surface = _cloud(*model.surface).voxel_down_sample(spacing)
        self._gates = gates
        self._reach = 0.6 * model.diameter

    def refine(self, T_camera_object: np.ndarray, scene: o3d.geometry.PointCloud) -> np.ndarray:
        """(4, 4) pose registered with the measured points, which have normals."""
        T, plane = T_camera_object, _REGISTRATION.TransformationEstimationPointToPlane()
        away = np.linalg.norm(np.asarray(scene.points) - T[:3, 3], axis=1)
        scene = scene.select_by_index(np.flatnonzero(away < self._reach))  # Open3D builds a tree of it each time
        points, normals = np.asarray(self._surface.points), np.asarray(self._surface.normals)
        for gate in self._gates:
            facing = np.einsum("ni,ni->n", points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T) < 0
            visible = self._surface.select_by_index(np.flatnonzero(facing))
            T = _projected(_REGISTRATION.registration_icp(visible, scene, gate, T, plane).transformation)
        return T


class PointPairFeatures:
    """OpenCV contrib's ``ppf_match_3d`` (Drost et al. 2010), ICP on its best clusters of votes."""

    def __init__(
        self, model: ObjectModel, *, sampling: float = 0.09, scene_step: float = 0.5, refined: int = 150
    ) -> None:
        """
        Args:
            model: the object.
            sampling: of model and scene, as a share of the model's extent.
            scene_step: share of the sampled scene points that vote.
            refined: most clusters of votes that go on to ICP.

        Raises:
            ValueError: OpenCV is not installed, or without its contrib modules; the message says what to install.
        """
        self._model, self._sampling, self._step, self._refined = model, sampling, scene_step, refined
        # OpenCV clusters poses by their distance in the clouds' own unit, but means shares of the model.
        points = _oriented(model.surface[0] / model.diameter, model.surface[1])
        self._extent = np.linalg.norm(np.ptp(points[:, :3], axis=0))
        self._detector = _require_ppf().PPF3DDetector(sampling, sampling, 30)
        self._detector.trainModel(points)
        self._icp = VisibleIcp(model, 0.03 * model.diameter)
        self._check = DepthCheck(model)

    def estimate(self, view: View) -> Hypotheses:
        """See :meth:`active6d_perception.estimators.registry.Estimator.estimate`."""
        surface = measure_surface(view.depth, view.camera, self._model.diameter)
        scene = _scene_cloud(surface, 0.02 * self._model.diameter)
        if len(scene.points) < _FEWEST_POINTS:
            return Hypotheses.empty(view.camera.height, view.camera.width)
        oriented = _oriented(np.asarray(scene.points) / self._model.diameter, np.asarray(scene.normals))
        # OpenCV takes its steps as shares of each cloud's own extent, ours is a share of the model's.
        extent = self._extent / np.linalg.norm(np.ptp(oriented[:, :3], axis=0))
        clusters = self._detector.match(oriented, self._step, float(self._sampling * extent))
        poses = []
        for cluster in sorted(clusters, key=lambda cluster: -cluster.numVotes)[: self._refined]:
            T = _projected(np.array(cluster.pose))
            T[:3, 3] *= self._model.diameter
            poses.append(self._icp.refine(T, scene))
        return self._check.report(np.array(poses).reshape(-1, 4, 4), surface, view)


class FeatureMatching:
    """Open3D's FPFH features and RANSAC over their matches, started all over the scene, then ICP."""

    def __init__(self, model: ObjectModel, *, voxel: float = 0.035, crops: int = 60, iterations: int = 20_000) -> None:
        """
        Args:
            model: the object.
            voxel: spacing of the points as a share of the diameter.
            crops: places in the scene around which the model is looked for.
            iterations: most draws of RANSAC a crop.
        """
        self._model, self._crops = model, crops
        self._voxel = voxel * model.diameter
        self._sparse = _cloud(*model.surface).voxel_down_sample(self._voxel)
        self._features = self._describe(self._sparse)
        self._criteria = _REGISTRATION.RANSACConvergenceCriteria(iterations, 0.999)
        self._icp = VisibleIcp(model, 0.03 * model.diameter)
        self._check = DepthCheck(model)

    def estimate(self, view: View) -> Hypotheses:
        """See :meth:`active6d_perception.estimators.registry.Estimator.estimate`."""
        surface = measure_surface(view.depth, view.camera, self._model.diameter)
        scene = _scene_cloud(surface, self._voxel)
        if len(scene.points) < _FEWEST_POINTS:
            return Hypotheses.empty(view.camera.height, view.camera.width)
        features = self._describe(scene)
        points = np.asarray(scene.points)
        o3d.utility.random.seed(0)
        poses = []
        for seed in np.asarray(scene.farthest_point_down_sample(min(self._crops, len(points))).points):
            crop = np.flatnonzero(np.linalg.norm(points - seed, axis=1) < 0.5 * self._model.diameter)
            if len(crop) >= 20:
                T = self._align(scene.select_by_index(crop), features.select_by_index(crop))
                poses.append(self._icp.refine(T, scene))
        return self._check.report(np.array(poses).reshape(-1, 4, 4), surface, view)

    def _describe(self, cloud: o3d.geometry.PointCloud) -> Any:
        around = o3d.geometry.KDTreeSearchParamHybrid(radius=5 * self._voxel, max_nn=100)
        return _REGISTRATION.compute_fpfh_feature(cloud, around)

    def _align(self, crop: o3d.geometry.PointCloud, features: Any) -> np.ndarray:
        """(4, 4) pose of the model that one crop suggests."""
        # From the scene to the model: any point of a crop may lie on a neighbour, but all of the model is there.
        reach = 1.5 * self._voxel
        found = _REGISTRATION.registration_ransac_based_on_feature_matching(
            crop,
            self._sparse,
            features,
            self._features,
            mutual_filter=False,
            max_correspondence_distance=reach,
            estimation_method=_REGISTRATION.TransformationEstimationPointToPoint(),
            ransac_n=3,
            checkers=[
                _REGISTRATION.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                _REGISTRATION.CorrespondenceCheckerBasedOnDistance(reach),
            ],
            criteria=self._criteria,
        )
        return invert(np.array(found.transformation))


#: Name to factory; a factory raises ValueError where its library is missing.
PEERS: dict[str, Callable[[ObjectModel], Estimator]] = {
    "opencv-ppf": PointPairFeatures,
    "fpfh-ransac": FeatureMatching,
}


def _require_ppf() -> Any:
    try:
        return import_module("cv2").ppf_match_3d
    except (ImportError, AttributeError) as error:
        raise ValueError(
            "the peer opencv-ppf needs OpenCV with its contrib modules; pip uninstall other opencv-python packages, "
            "then pip install opencv-contrib-python-headless"
        ) from error


def _oriented(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(n, 6) float32 as OpenCV wants it."""
    return np.ascontiguousarray(np.concatenate([points, normals], axis=1), np.float32)


def _projected(T: np.ndarray) -> np.ndarray:
    """(4, 4) with the rotation nearest to what is there: averages of quaternions left unnormalised are none."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    return make_transform(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, T[:3, 3])


def _scene_cloud(surface: Surface, spacing: float) -> o3d.geometry.PointCloud:
    """Foreground points and their normals, thinned out to ``spacing`` metres."""
    usable = surface.foreground & np.isfinite(surface.image.normals).all(axis=-1)
    cloud = _cloud(surface.image.points[usable], surface.image.normals[usable]).voxel_down_sample(spacing)
    return cloud.normalize_normals()


def _cloud(points: np.ndarray, normals: np.ndarray) -> o3d.geometry.PointCloud:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(float)))
    cloud.normals = o3d.utility.Vector3dVector(normals.astype(float))
    return cloud
