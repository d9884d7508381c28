"""Policies that leave: safe bundles for colleagues, ONNX for machines without torch."""

from sb3_flowpolicy.export.onnx_export import export_onnx

__all__ = ["export_onnx"]
