from pathlib import Path

from active6d_core.files import cache_folder, sha256_of


def test_the_cache_follows_the_xdg_variable(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder("banks") == tmp_path / "active6d" / "banks"
    monkeypatch.setenv("XDG_CACHE_HOME", "")  # as good as unset, says the specification
    assert cache_folder("banks") == Path.home() / ".cache" / "active6d" / "banks"


def test_sha256_is_the_published_one(tmp_path):
    (tmp_path / "weights").write_bytes(b"abc")  # FIPS 180-2, appendix B.1
    assert sha256_of(tmp_path / "weights") == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
