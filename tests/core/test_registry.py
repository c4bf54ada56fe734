from importlib.metadata import EntryPoint
from types import SimpleNamespace

import pytest

import active6d_core.registry
from active6d_core.object_model import load_object
from active6d_core.registry import AUTOMATIC, Registry


@pytest.fixture
def makers():
    registry = Registry("maker", lambda object_name: f"of-{object_name}", {"lazy": "no.such.module"})
    registry.register("of-mug")(lambda model, size=1: (model.name, size))
    return registry


def test_auto_is_what_the_object_calls_for(makers):
    assert makers.names() == ["lazy", "of-mug"]
    assert makers.create(AUTOMATIC, load_object("mug"), size=3) == makers.create("of-mug", load_object("mug"), size=3)
    assert makers.create("of-mug", load_object("bunny")) == ("bunny", 1)
    with pytest.raises(ValueError, match=r"^unknown maker 'of-bunny'; known: auto, lazy, of-mug$"):
        makers.create(AUTOMATIC, load_object("bunny"))


def test_a_built_in_part_is_imported_when_asked_for(makers):
    with pytest.raises(ValueError, match=r"^maker 'lazy' needs no, which is not installed$"):
        makers.create("lazy", load_object("mug"))


def test_refusals_name_the_part(makers):
    def refuse(model, size, scale=1.0, flat=False, words=""):
        if not size:
            raise TypeError("needs more")
        raise ValueError(f"size {size} is none")

    assert makers.register("strict")(refuse) is refuse
    makers.register("strict")(refuse)  # the same again, as when a module is imported twice
    with pytest.raises(ValueError, match=r"^maker 'strict' is registered already$"):
        makers.register("strict")(lambda model: None)
    for parameters, message in (
        ({"size": 7}, "maker 'strict': size 7 is none"),
        ({"size": 7, "scale": "x"}, "maker 'strict': parameter 'scale' must be a number such as 1.0, got 'x'"),
        ({"size": 7, "scale": True}, "maker 'strict': parameter 'scale' must be a number such as 1.0, got True"),
        ({"size": 7, "flat": 1}, "maker 'strict': parameter 'flat' must be a truth value such as False, got 1"),
        ({"size": "x", "words": 3}, "maker 'strict': parameter 'words' must be a text such as '', got 3"),
        ({"size": []}, r"maker 'strict': needs more; size is \[\]"),
        ({}, "maker 'strict' needs the parameter 'size'; give it with --set"),
        ({"speed": 1}, "maker 'strict' has no parameter 'speed'; it has: size, scale, flat, words"),
    ):
        with pytest.raises(ValueError, match=message):
            makers.create("strict", load_object("mug"), **parameters)


def entry_point(name, value, package="theirs"):
    found = EntryPoint(name, value, "active6d.makers")
    vars(found)["dist"] = SimpleNamespace(name=package, version="1.2")
    return found


@pytest.fixture
def extended(monkeypatch):
    """A registry, and what other packages declare."""

    def make(*declared):
        monkeypatch.setattr(active6d_core.registry, "entry_points", lambda group: list(declared))
        return Registry("maker", str, {"lazy": "no.such.module"}, "active6d.makers")

    return make


def test_entry_points_add_parts(extended):
    registry = extended(entry_point("theirs", "fractions:Fraction"), entry_point("broken", "no.such:thing"))
    registry.register("mine")(lambda model: None)
    assert registry.origins() == {"lazy": "built in", "theirs": "theirs 1.2", "broken": "theirs 1.2", "mine": __name__}
    assert registry.names() == ["broken", "lazy", "mine", "theirs"]
    with pytest.raises(ValueError, match=r"maker 'theirs' has no parameter 'size'; it has: numerator, denominator"):
        registry.create("theirs", load_object("mug"), size=1)
    with pytest.raises(ValueError, match=r"^maker 'broken' of theirs 1.2 \(no.such:thing\) cannot be imported"):
        registry.create("broken", load_object("mug"))


def test_entry_points_that_name_no_factory_are_refused(extended):
    with pytest.raises(ValueError, match=r"^maker 'x' of theirs 1.2 \(sys:version\) cannot be called"):
        extended(entry_point("x", "sys:version")).create("x", load_object("mug"))


def test_two_parts_of_one_name_are_refused(extended):
    for first in ("lazy", "x"):
        registry = extended(entry_point("x", "a:b"), entry_point(first, "c:d", "others"))
        message = f"'{first}': (built in|theirs 1.2) and others 1.2"
        with pytest.raises(ValueError, match=message):
            registry.names()
