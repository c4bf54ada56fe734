"""Comparing the methods of fusion: what counts as found and wrong, and that both see the same views."""

import numpy as np
import pytest
from hand_made_scenes import make_scene, three_mugs

from active6d_perception.scene.belief_weights import BeliefWeights
from active6d_perception.scene.fusion import FusionParameters
from active6d_tools.benchmark.fusion_methods import MethodResults, compare_methods


def test_only_confirmed_objects_count_and_wrong_ones_are_told():
    # Two true objects. Reported: the first within 1 mm, the second within 2 mm but improbable, and a wrong one.
    errors = np.array([[0.001, np.inf], [np.inf, 0.002], [0.03, np.inf]])
    results = MethodResults(0.1, [errors], [np.array([0.9, 0.3, 0.8])], [4.0, 6.0])
    row = results.summarise(0.5)
    assert row["found"] == 0.5
    assert row["found_of_all"] == 1.0
    assert row["wrong"] == 0.5
    assert row["wrong_of_all"] == pytest.approx(1 / 3)
    assert (row["confirmed"], row["reported"], row["ms"]) == (2, 3, 5.0)
    assert row["e_add_mm"] == pytest.approx((1 + 50) / 2)
    assert row["median_e_add_mm"] == pytest.approx(1.0)
    assert row["auc"] == pytest.approx(0.5)


@pytest.mark.slow
def test_methods_fuse_the_same_views(tmp_path, monkeypatch):
    monkeypatch.setenv("ACTIVE6D_SCENE_PATH", str(tmp_path))
    mugs = three_mugs()
    (tmp_path / "mug").mkdir()
    make_scene(mugs.T_world_object, mugs.bin, "mug/val/0", 2).save(tmp_path / "mug" / "val_00.npz")
    indifferent = lambda path: BeliefWeights.indifferent()
    monkeypatch.setattr("active6d_perception.scene.joint_fusion.load_belief", indifferent)
    results = compare_methods(["mug/val/0"], kinds=("ring",), episodes=1, parameters=FusionParameters(confirmed=0.0))
    assert set(results["ring"]) == {"best-view", "all-views"}
    for row in results["ring"].values():
        # Most mugs are found; with indifferent weights the rotation may be wrong.
        assert row["reported"] >= 3
        assert row["ms"] > 0
    assert results["ring"]["best-view"]["found"] >= 2 / 3
