"""Leaves out the candidates of a bank that hardly any choice of views makes probable.

A grid of views proposes nine candidates for every object. What each view says of each of them, at every rotation, would
be most of the bank: 20 of 26 MB for ten scenes of mugs. Without the improbable ones, nearly the same is found.
Objects without an ambiguous rotation have small banks and keep all candidates: without them, more wrong cups were
confirmed.
"""

from dataclasses import replace

import numpy as np

from active6d_agent.bank.all_views_lookup import AllViewsLookup, evidence_of
from active6d_agent.bank.belief_kernel import SceneIndex
from active6d_agent.bank.scene_bank import BankScene, SceneBank

_EPISODES = 600
#: Numbers of views of the episodes, drawn with the same probability.
_VIEWS = (1, 2, 3, 4, 5, 6, 6, 6, 11)
#: A candidate that is never more probable in these episodes is left out.
_LEAST_PROBABILITY = 0.2
#: So is a place for which the hypotheses of all views have less evidence: sums of squared confidences.
_LEAST_EVIDENCE = 1.0


def prune_candidates(bank: SceneBank, rng: np.random.Generator) -> SceneBank:
    """Leave out improbable candidates of a bank whose object has an ambiguous rotation.

    Args:
        bank: scenes with evidence.
        rng: draws the views of the episodes.

    Raises:
        ValueError: a scene has no evidence.
    """
    if all(evidence_of(scene).T_world_object.shape[1] == 1 for scene in bank.scenes):
        return bank
    lookup = AllViewsLookup(bank)
    best = _highest_probabilities(lookup, rng)
    scenes = [
        _kept(scene, index, probability)
        for scene, index, probability in zip(bank.scenes, lookup.scenes, best, strict=True)
    ]
    return replace(bank, scenes=scenes)


def _highest_probabilities(lookup: AllViewsLookup, rng: np.random.Generator) -> list[np.ndarray]:
    """(K,) highest probability of each candidate of each scene in random episodes."""
    every, views = np.arange(len(lookup.scenes)), len(lookup.sphere)
    rotations = [index.telling.shape[2] for index in lookup.scenes]
    best = [np.zeros(len(index.place)) for index in lookup.scenes]
    for _ in range(_EPISODES):
        count = min(int(rng.choice(_VIEWS)), views)
        taken = np.stack([rng.choice(views, count, replace=False) for _ in every])
        fused = lookup.fuse(every, taken, taken[:, -1])
        for scene in every:
            shown = fused.objects[scene] >= 0
            pose = fused.objects[scene][shown].astype(int) - lookup.first_pose[scene]
            np.maximum.at(best[scene], pose // rotations[scene], fused.probability[scene][shown])
    return best


def _kept(scene: BankScene, index: SceneIndex, probability: np.ndarray) -> BankScene:
    stands_for = index.candidate >= 0
    places = index.place[index.candidate[stands_for]]
    evidence = np.bincount(places, index.confidence[stands_for] ** 2, minlength=int(index.place.max(initial=-1)) + 1)
    kept = np.flatnonzero((probability >= _LEAST_PROBABILITY) & (evidence[index.place] >= _LEAST_EVIDENCE))
    return replace(scene, evidence=evidence_of(scene).take(kept))
