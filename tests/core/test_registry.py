import pytest

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
    with pytest.raises(ModuleNotFoundError, match="No module named 'no'"):
        makers.create("lazy", load_object("mug"))


def test_refusals_name_the_part(makers):
    def refuse(model, size):
        raise ValueError(f"size {size} is none")

    assert makers.register("strict")(refuse) is refuse
    makers.register("strict")(refuse)  # the same again, as when a module is imported twice
    with pytest.raises(ValueError, match=r"^maker 'strict' is registered already$"):
        makers.register("strict")(lambda model: None)
    for parameters, message in (
        ({"size": 7}, "maker 'strict': size 7 is none"),
        ({}, "maker 'strict': .*missing 1 required"),
        ({"speed": 1}, "maker 'strict' has no parameter 'speed'; it has: size"),
    ):
        with pytest.raises(ValueError, match=message):
            makers.create("strict", load_object("mug"), **parameters)
