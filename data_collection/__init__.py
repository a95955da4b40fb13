"""Datasets of RGB-D episodes: policies that act, the collector, the format, inspection."""
