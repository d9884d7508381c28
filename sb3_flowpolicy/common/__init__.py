"""Shared by several packages: argument checks, files, statistics, command lines, environments."""
