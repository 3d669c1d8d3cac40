"""Heads: from clicks to scores, with batch normalisation right after the detection.

Owns the digital back end in torch; never samples. A head takes click means (n, d_f) in [0, 1] and returns scores
(n, classes); `words` gives the scores of all click words under the statistics of one batch.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

MOMENTUM = 0.05
EPSILON = 1e-5


class ClickNorm(nn.Module):
    """Batch normalisation of binary features: their population variance is p(1-p), so that only the mean is kept."""

    running_mean: Tensor

    def __init__(self, n_features: int) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.ones(n_features))
        self.bias = nn.Parameter(torch.zeros(n_features))
        self.register_buffer("running_mean", torch.full((n_features,), 0.5))

    def forward(self, clicks: Tensor, mean: Tensor | None = None) -> Tensor:
        """Normalise `clicks` (n, d_f) by `mean` (d_f,), by default that of the batch in training, else the running one."""
        if mean is None:
            mean = clicks.mean(dim=0) if self.training else self.running_mean
        if self.training:
            with torch.no_grad():
                self.running_mean.lerp_(mean, MOMENTUM)
        normal: Tensor = (clicks - mean) / torch.sqrt(mean * (1 - mean) + EPSILON) * self.gain + self.bias
        return normal


class MlpHead(nn.Module):
    """Normalisation, one hidden layer with ReLU, scores (paper: 512 hidden units)."""

    def __init__(self, n_features: int, n_hidden: int, n_classes: int, generator: torch.Generator) -> None:
        super().__init__()
        self.norm = ClickNorm(n_features)
        self.hidden = nn.Linear(n_features, n_hidden)
        self.output = nn.Linear(n_hidden, n_classes)
        with torch.no_grad():  # torch's own initial range, from our generator
            for layer in (self.hidden, self.output):
                bound = layer.in_features**-0.5
                for parameter in (layer.weight, layer.bias):
                    parameter.copy_((torch.rand(parameter.shape, generator=generator) * 2 - 1) * bound)

    def forward(self, clicks: Tensor, mean: Tensor | None = None) -> Tensor:
        """Return scores (n, classes) of click means (n, d_f); `mean` as in `ClickNorm`."""
        scores: Tensor = self.output(torch.relu(self.hidden(self.norm(clicks, mean))))
        return scores

    def flipped(self, clicks: Tensor, mean: Tensor) -> Tensor:
        """Return scores (n, d_f, classes): in column i click i is inverted. The hidden sums are made once and corrected."""
        scale = self.norm.gain / torch.sqrt(mean * (1 - mean) + EPSILON)
        sums = self.hidden((clicks - mean) * scale + self.norm.bias)
        columns = (self.hidden.weight * scale).T  # (d_f, hidden)
        changed = torch.addcmul(sums.unsqueeze(1), (1 - 2 * clicks).unsqueeze(2), columns.unsqueeze(0))
        scores: Tensor = self.output(changed.relu_())
        return scores
