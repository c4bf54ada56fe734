"""The scene from several views: verification, fusion, observed surface and expected visibility."""
