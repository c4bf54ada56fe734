"""The learned estimator: a network predicts centre, axis and rotation per pixel, and poses follow from them.

``docs/estimator.md`` explains the design.
"""
