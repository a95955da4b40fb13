"""Exports of a dataset into the formats of other projects."""
