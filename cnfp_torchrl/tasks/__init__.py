"""Environments that come with the library, each with geometry, judge and pictures of its own."""
