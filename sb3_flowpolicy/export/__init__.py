"""Export models to safe bundles (safetensors) and to ONNX."""

from sb3_flowpolicy.export.onnx_export import export_onnx

__all__ = ["export_onnx"]
