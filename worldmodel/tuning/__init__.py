"""Tuning: a search over the learning rate and the objective's weights, on Ray Tune."""
