"""Density fitting (thesis chapter 2.1): what small flows can express, measured on data."""
