"""Differentiable parts: detection, encoders, heads, estimators, quantisation, SSIM."""
