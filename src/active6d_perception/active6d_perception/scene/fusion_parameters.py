"""Settings that both kinds of fusion share."""

from dataclasses import dataclass

from active6d_perception.scene.observed_surface import EXPLAINED_WITHIN

#: How views are fused, the default first: by all depth images together (:class:`.AllViewsFusion`), or as in the paper,
#: by the best hypothesis of a single view (:class:`.BestViewFusion`).
METHODS = ("all-views", "best-view")
#: Ways to rank hypotheses, see :class:`FusionParameters`.
RANKINGS = ("evidence", "confidence", "verification", "score")


@dataclass(frozen=True)
class FusionParameters:
    """Settings of the fusion.

    Distances that tell objects apart (``cut`` and ``exclusion``) are smaller for slim objects, which can lie nearer to
    each other than a fifth of their diameter: see :func:`.slimness`, by which both are multiplied.

    Attributes:
        cut: clusters are merged while their mean distance is at most this fraction of the diameter, less for slim
            objects.
        exclusion: of two objects whose origins are closer than this fraction of the diameter, less for slim objects,
            only the better one is kept. Solid objects cannot share a centre, but a pose that is ambiguous in some views
            (a mug with a hidden handle) gives several clusters there. 0 keeps all.
        min_verification: hypotheses with a lower verification score are not used. The paper uses all: -1, the default.
        rank_by: the criterion for the best hypothesis of a cluster, and for the best of clusters at one place.
            ``verification`` is equation 1, as in the paper. ``score`` is the estimator's score.
            ``confidence`` is the product of both, because equation 1 cannot see everything: a mug with a hidden handle
            fits its pixels at every rotation. With these three a cluster is ranked by its best hypothesis, so that one
            overconfident wrong view can win. ``evidence`` takes the hypothesis with the highest confidence, and ranks
            clusters by the sum of their squared confidences, so that views which agree win.
        confirmed: objects with at least this probability count; the others are shown, and worth another view.
        least_probability: objects less probable than this are withdrawn. Only :class:`.AllViewsFusion` withdraws.
        explained_within: an object explains surface at most this fraction of the diameter away, see
            :class:`~active6d_perception.scene.observed_surface.Explainer`.

    Raises:
        ValueError: a value is out of range.
    """

    cut: float = 0.2
    exclusion: float = 0.2
    min_verification: float = -1.0
    rank_by: str = "evidence"
    confirmed: float = 0.5
    least_probability: float = 0.02
    explained_within: float = EXPLAINED_WITHIN

    def __post_init__(self) -> None:
        if not self.cut > 0:
            raise ValueError(f"fusion: cut must be positive, got {self.cut}")
        if not self.exclusion >= 0:
            raise ValueError(f"fusion: exclusion must not be negative, got {self.exclusion}")
        if not -1 <= self.min_verification <= 1:
            raise ValueError(f"fusion: min_verification must be in [-1, 1], got {self.min_verification}")
        for name in ("confirmed", "least_probability"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"fusion: {name} must be in [0, 1], got {getattr(self, name)}")
        if not 0 < self.explained_within <= 1:
            raise ValueError(f"fusion: explained_within must be in (0, 1], got {self.explained_within}")
        if self.rank_by not in RANKINGS:
            raise ValueError(f"fusion: rank_by must be one of {', '.join(RANKINGS)}, got {self.rank_by!r}")
