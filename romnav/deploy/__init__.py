"""Policies that leave: exported to ONNX, and run on a robot's sensors at the control rate."""
