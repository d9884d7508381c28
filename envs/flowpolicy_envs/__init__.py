"""Gymnasium environments that need correlated exploration."""
