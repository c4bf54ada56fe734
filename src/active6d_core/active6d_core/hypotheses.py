"""Tables of the pose hypotheses of one view and of the fused objects of a scene, as structs of arrays."""

from dataclasses import dataclass, fields, replace

import numpy as np
from scipy.ndimage import find_objects


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """k pose hypotheses of one view.

    Attributes:
        T_camera_object: (k, 4, 4) poses in the optical frame, metres.
        score: (k,) confidence of the estimator in [0, 1]; ranks hypotheses.
        box: (k, 4) x_min, y_min, x_max, y_max of the mask over image width and height, in [0, 1] (paper: b).
        depth: (k,) mean depth over the mask in metres (paper: d).
        label: (k,) uint16, value of the hypothesis in ``segmentation``, from 1; hypotheses that are alternatives for
            one instance share a label.
        segmentation: (H, W) uint16 label per pixel, 0 for background.

    Raises:
        ValueError: array shapes disagree.
    """

    T_camera_object: np.ndarray
    score: np.ndarray
    box: np.ndarray
    depth: np.ndarray
    label: np.ndarray
    segmentation: np.ndarray

    def __post_init__(self) -> None:
        k = len(self.score)
        expected = {"T_camera_object": (k, 4, 4), "score": (k,), "box": (k, 4), "depth": (k,), "label": (k,)}
        for name, shape in expected.items():
            actual = np.shape(getattr(self, name))
            if actual != shape:
                raise ValueError(f"hypotheses: {name} has shape {actual}, expected {shape}")
        if np.ndim(self.segmentation) != 2:
            raise ValueError(f"hypotheses: segmentation must be (H, W), got {np.shape(self.segmentation)}")

    def __len__(self) -> int:
        return len(self.score)

    @classmethod
    def from_masks(
        cls,
        T_camera_object: np.ndarray,
        score: np.ndarray,
        label: np.ndarray,
        segmentation: np.ndarray,
        depth_image: np.ndarray,
    ) -> "Hypotheses":
        """Build the table, with boxes and depths from the masks (paper, "Objects feature representation").

        Args:
            T_camera_object: (k, 4, 4) poses in the optical frame, metres.
            score: (k,) in [0, 1].
            label: (k,) labels that occur in ``segmentation``.
            segmentation: (H, W) uint16 label per pixel, 0 for background.
            depth_image: (H, W) metres along z, NaN invalid; a mask without valid depth takes the z of the pose.

        Raises:
            ValueError: a label has no pixel.
        """
        height, width = segmentation.shape
        label = np.asarray(label, np.uint16)
        flat = segmentation.ravel()
        members = np.flatnonzero(flat)
        labels_of_members = flat[members].astype(np.intp)
        size = int(max(labels_of_members.max(initial=0), label.max(initial=0))) + 1
        found = [None, *find_objects(segmentation, size - 1)]
        if any(found[index] is None for index in label):
            raise ValueError("hypotheses: a label has no pixel in the segmentation")
        pixels = [
            (columns.start, rows.start, columns.stop, rows.stop) for rows, columns in map(found.__getitem__, label)
        ]
        z = depth_image.ravel()[members]
        valid = np.isfinite(z)
        count = np.bincount(labels_of_members[valid], minlength=size)[label]
        total = np.bincount(labels_of_members[valid], weights=z[valid], minlength=size)[label]
        depth = np.where(count > 0, total / np.maximum(count, 1), T_camera_object[:, 2, 3])
        box = np.reshape(pixels, (-1, 4)) / (width, height, width, height)
        return cls(np.asarray(T_camera_object, float), np.asarray(score, float), box, depth, label, segmentation)

    def take(self, index: np.ndarray) -> "Hypotheses":
        """The hypotheses at ``index`` (integers or a mask), in that order; the segmentation stays whole."""
        columns = {item.name: getattr(self, item.name)[index] for item in fields(self) if item.name != "segmentation"}
        return replace(self, **columns)

    def ranked(self) -> "Hypotheses":
        """The same hypotheses, the highest score first."""
        return self.take(np.argsort(-self.score, kind="stable"))

    @classmethod
    def empty(cls, height: int, width: int) -> "Hypotheses":
        """A table without hypotheses, for an image of the given size in pixels."""
        none = np.zeros(0)
        return cls(
            np.zeros((0, 4, 4)),
            none,
            np.zeros((0, 4)),
            none,
            none.astype(np.uint16),
            np.zeros((height, width), np.uint16),
        )


@dataclass(frozen=True, eq=False)
class SceneObjects:
    """n accumulated objects in the world (the paper's selected hypotheses and their features B_t).

    Attributes:
        T_world_object: (n, 4, 4) poses in the world, metres.
        verification: (n,) verification score c (equation 1) of the selected hypothesis, in the view that it is from.
        score: (n,) score of the selected hypothesis in [0, 1].
        box: (n, 4) normalised box in the current camera (paper: b), re-projected for objects not seen in this view.
        depth: (n,) metres along z in the current camera (paper: d).
        support: (n,) int, number of views with a hypothesis in the object's cluster.
        spread: (n,) how far its hypotheses disagree, metres: the largest distance of two, or of one from an
            object that is fused from all views.
        probability: (n,) in [0, 1], that the ADD of the pose is below 10 % of the diameter.
        entropy: (n,) of the belief over the poses that are possible at the object's place, nats; 0 if only one was
            considered.

    Raises:
        ValueError: array shapes disagree.
    """

    T_world_object: np.ndarray
    verification: np.ndarray
    score: np.ndarray
    box: np.ndarray
    depth: np.ndarray
    support: np.ndarray
    spread: np.ndarray
    probability: np.ndarray
    entropy: np.ndarray

    def __post_init__(self) -> None:
        n = len(self.verification)
        for item in fields(self):
            shape = np.shape(getattr(self, item.name))
            expected = {"T_world_object": (n, 4, 4), "box": (n, 4)}.get(item.name, (n,))
            if shape != expected:
                raise ValueError(f"scene objects: {item.name} has shape {shape}, expected {expected}")

    def __len__(self) -> int:
        return len(self.verification)

    @classmethod
    def empty(cls) -> "SceneObjects":
        """A table without objects."""
        none = np.zeros(0)
        return cls(np.zeros((0, 4, 4)), none, none, np.zeros((0, 4)), none, np.zeros(0, int), none, none, none)

    def features(self) -> np.ndarray:
        """(n, 6) box, depth and verification score: the tuple (b, d, c) of the paper's attention module."""
        return np.concatenate([self.box, self.depth[:, None], self.verification[:, None]], axis=1)

    def take(self, index: np.ndarray) -> "SceneObjects":
        """The objects at ``index`` (integers or a mask), in that order."""
        return replace(self, **{item.name: getattr(self, item.name)[index] for item in fields(self)})
