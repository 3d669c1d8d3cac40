"""Heads: from clicks to scores, with batch normalisation right after the detection.

A head takes click means (n, d_f) in [0, 1] and returns scores (n, classes), or pixels (n, height * width); `changed` gives them for every
word that differs in one click.

- `MlpHead`: one hidden layer, the paper's (512 units).
- `DeepHead`: two hidden layers, the paper's for cells (512 and 512 units).
- `ConvHead`: convolutions along the patterns, kernel 15 as in the paper's comparison, for any number of patterns.
- `PictureHead`: an image decoder, from clicks to a coarse picture and by transposed convolutions to the full one.
- `DecoderHead`: an image decoder of two hidden layers, the paper's (512 and 512 units); a seventh of the other's time per picture.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

import pans_trainer.device  # noqa: F401  # before a convolution: it sets what torch needs on this processor
from pans_trainer.options import PICTURE_HEADS, Options

KERNEL = 15  # the paper, comparison of back ends
CHANNELS = (32, 64)
MOMENTUM = 0.05  # torch's own is 0.1
EPSILON = 1e-5  # that of torch.nn.BatchNorm1d

Shape = tuple[int, int]  # height and width of a picture


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


class _Head(nn.Module):
    """What heads share: normalisation, a first linear layer `hidden` with ReLU, and `rest` behind it."""

    output: nn.Linear

    def __init__(self, n_features: int, n_inputs: int, n_hidden: int) -> None:
        super().__init__()
        self.norm = ClickNorm(n_features)
        self.hidden = nn.Linear(n_inputs, n_hidden)

    def inputs(self, normal: Tensor) -> Tensor:
        """Return what the first layer sees of normalised clicks (n, d_f): by default the clicks themselves."""
        return normal

    def rest(self, hidden: Tensor) -> Tensor:
        """Return scores (..., classes) or pixels (..., height * width), about 0 to 1, of hidden units (..., hidden)."""
        outputs: Tensor = self.output(hidden)
        return outputs

    def forward(self, clicks: Tensor, mean: Tensor | None = None) -> Tensor:
        """Return the outputs (n, out) of click means (n, d_f); `mean` as in `ClickNorm`."""
        return self.rest(torch.relu(self.hidden(self.inputs(self.norm(clicks, mean)))))

    def changed(self, clicks: Tensor, mean: Tensor, by: Tensor) -> Tensor:
        """Return the outputs (n, d_f, out): in column i `by` (n, d_f) is added to click i alone."""
        outputs = []
        for i in range(clicks.shape[1]):
            other = clicks.clone()
            other[:, i] += by[:, i]
            outputs.append(self(other, mean))
        return torch.stack(outputs, dim=1)


class _DenseHead(_Head):
    """A head whose first layer sees the clicks: with one of them changed, its sums are corrected instead of made anew."""

    def changed(self, clicks: Tensor, mean: Tensor, by: Tensor) -> Tensor:
        """Return the outputs (n, d_f, out): in column i `by` (n, d_f) is added to click i alone."""
        scale = self.norm.gain / torch.sqrt(mean * (1 - mean) + EPSILON)
        sums = self.hidden((clicks - mean) * scale + self.norm.bias)
        columns = (self.hidden.weight * scale).T  # (d_f, hidden)
        changed = torch.addcmul(sums.unsqueeze(1), by.unsqueeze(2), columns.unsqueeze(0))
        return self.rest(changed.relu_())


class MlpHead(_DenseHead):
    """One hidden layer, scores (paper: 512 hidden units)."""

    def __init__(self, n_features: int, n_hidden: int, n_classes: int, generator: torch.Generator) -> None:
        super().__init__(n_features, n_features, n_hidden)
        self.output = nn.Linear(n_hidden, n_classes)
        _start(generator, self.hidden, self.output)


class DeepHead(_DenseHead):
    """Two hidden layers with ReLU, scores (paper, cells: 512 and 512 hidden units)."""

    def __init__(self, n_features: int, n_hidden: int, n_outputs: int, generator: torch.Generator) -> None:
        super().__init__(n_features, n_features, n_hidden)
        self.second = nn.Linear(n_hidden, n_hidden)
        self.output = nn.Linear(n_hidden, n_outputs)
        _start(generator, self.hidden, self.second, self.output)

    def rest(self, hidden: Tensor) -> Tensor:
        return super().rest(torch.relu(self.second(hidden)))


class ConvHead(_Head):
    """Two convolutions along the patterns that halve the length, one hidden layer, scores."""

    def __init__(self, n_features: int, n_hidden: int, n_classes: int, generator: torch.Generator) -> None:
        length = -(-n_features // 4)  # each convolution rounds half the length up
        super().__init__(n_features, CHANNELS[-1] * length, n_hidden)
        half = KERNEL // 2
        self.convolutions = nn.ModuleList(
            nn.Conv1d(before, after, KERNEL, stride=2, padding=half) for before, after in pairwise((1, *CHANNELS))
        )
        self.output = nn.Linear(n_hidden, n_classes)
        _start(generator, *self.convolutions, self.hidden, self.output)

    def inputs(self, normal: Tensor) -> Tensor:
        """Return the maps behind the convolutions, flat: (n, channels * length)."""
        maps = normal.unsqueeze(1)
        for convolution in self.convolutions:
            maps = torch.relu(convolution(maps))
        return maps.flatten(1)


class PictureHead(_Head):
    """A hidden layer, a coarse picture of a quarter of the size, two transposed convolutions."""

    def __init__(self, n_features: int, n_hidden: int, image_shape: Shape, generator: torch.Generator) -> None:
        super().__init__(n_features, n_features, n_hidden)
        self.image_shape = image_shape
        self.coarse = (-(-image_shape[0] // 4), -(-image_shape[1] // 4))
        self.spread = nn.Linear(n_hidden, CHANNELS[-1] * self.coarse[0] * self.coarse[1])
        self.up = nn.ModuleList(
            nn.ConvTranspose2d(before, after, 4, stride=2, padding=1)
            for before, after in pairwise((CHANNELS[-1], CHANNELS[0], 1))
        )
        _start(generator, self.hidden, self.spread, *self.up)

    def rest(self, hidden: Tensor) -> Tensor:
        maps = torch.relu(self.spread(hidden)).unflatten(1, (CHANNELS[-1], *self.coarse))
        picture: Tensor = self.up[1](torch.relu(self.up[0](maps)))
        return picture[:, 0, : self.image_shape[0], : self.image_shape[1]].flatten(1)


class DecoderHead(DeepHead):
    """Two hidden layers with ReLU, pixels (paper: d_f, 512, 512, 784)."""

    def __init__(self, n_features: int, n_hidden: int, image_shape: Shape, generator: torch.Generator) -> None:
        super().__init__(n_features, n_hidden, image_shape[0] * image_shape[1], generator)
        self.image_shape = image_shape


Decoders = PictureHead | DecoderHead  # what returns pictures
Heads = MlpHead | DeepHead | ConvHead | Decoders
OF_CLASSES: dict[str, type[MlpHead | DeepHead | ConvHead]] = {"mlp": MlpHead, "deep": DeepHead, "conv": ConvHead}


def new_head(options: Options, n_outputs: int, image_shape: Shape, random: torch.Generator) -> Heads:
    """Return the untrained head that `options` ask for; `image_shape` is that of the picture to give back."""
    if options.head in PICTURE_HEADS:
        decoder = PictureHead if options.head == "picture" else DecoderHead
        return decoder(options.features, options.hidden, image_shape, random)
    return OF_CLASSES[options.head](options.features, options.hidden, n_outputs, random)


def _start(generator: torch.Generator, *layers: nn.Module) -> None:
    """Torch's own initial range, from our generator."""
    with torch.no_grad():
        for layer in layers:
            weight = layer.weight
            assert isinstance(weight, Tensor)
            inputs = weight[:, 0].numel() if isinstance(layer, nn.ConvTranspose2d) else weight[0].numel()
            for parameter in layer.parameters():
                parameter.copy_((torch.rand(parameter.shape, generator=generator) * 2 - 1) * inputs**-0.5)
