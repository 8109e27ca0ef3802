"""Differentiable rasterisation: one signature, the backend chosen by the tensors' device."""
