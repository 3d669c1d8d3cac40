"""What a training sees: the objects of a task as transmissions, fields or intensities, and the part kept for validation."""

from __future__ import annotations

import torch
from torch import Tensor

from pans.base.errors import UsageError
from pans.bundle.sensor import incident_field, incident_intensity
from pans.instrument.click_law import object_transmission
from pans.instrument.optics import tolerance_of
from pans.instrument.profile import Profile
from pans_trainer.device import here
from pans_trainer.model.field_basis import discriminant_basis
from pans_trainer.model.imaging import DrawnOptics
from pans_trainer.options import Options
from pans_trainer.tasks.changes import shifted, with_copies
from pans_trainer.tasks.registry import Objects, Task

VALIDATION_PART = 12  # one in 12 training objects, the last ones, only chooses among restarts
CHUNK = 2000  # objects per pass where no gradient is needed


class TrainingData:
    """Training objects as tensors: `shown` is what the encoder gets, (n, inputs); `target` a label, or an image in [0, 1].

    Active: float32 transmission with a perfect black, `floor` being the real one. Passive: incident field or intensity;
    with `Options.fields` its coordinates in `basis` (inputs, size), else None.
    """

    def __init__(self, task: Task, profile: Profile, options: Options) -> None:
        self.floor = profile.min_transmission if options.encoder == "active" else 0.0
        n_validation = task.kept or max(1, len(task.train) // VALIDATION_PART)
        objects = with_copies(task.train, n_validation, options.copies, options.seed, task.imaged)
        placed = shifted(objects, options.shift_px, options.offset_px, options.seed)
        self.shown = encoder_input(task, placed, profile, options)
        self.basis = discriminant_fields(task, options) if options.fields else None
        if self.basis is not None:
            self.shown = self.shown @ self.basis
        self.labels = torch.from_numpy(placed.labels)
        self.image_shape = task.image_shape
        self.is_image = task.target == "image"
        if self.is_image:
            flat = placed.pictures.reshape(len(placed), -1)
            self.target, self.n_outputs = torch.from_numpy(flat.astype("float32") / 255), flat.shape[1]
        else:
            self.target, self.n_outputs = self.labels, len(task.classes)
        self.shown, self.labels, self.target = here(self.shown), here(self.labels), here(self.target)
        self.picture_shape = self.image_shape if self.is_image else None  # of what is to be given back
        self.n_fit = len(self.labels) - n_validation
        tolerance = None if options.optics is None else tolerance_of(options.optics)
        self.optics = None if tolerance is None else DrawnOptics(tolerance, task.image_shape, options.seed)

    def drawn(self, number: int, floor: float) -> tuple[Tensor, float]:
        """Return the objects for an epoch, and the black that is still to be lifted: drawn optics show that of the modulator too.

        `number` counts the draws of optics. Without any the objects are `shown`.
        """
        if self.optics is None:
            return self.shown, floor
        return self.optics.through((1.0 - floor) * self.shown + floor, number), 0.0


def discriminant_fields(task: Task, options: Options, *, turned: bool = False) -> Tensor:
    """Return the fields (pixels, classes * `options.fields`) in which a coherent encoder is trained (model/field_basis.py).

    Orthonormal where light is conserved, so that the encoder's limit is that of its coefficients. UsageError for complex fields.
    """
    field = torch.from_numpy(incident_field(task.train.images, task.light, task.optics)).flatten(1)
    if field.is_complex():
        raise UsageError(f"--fields: the field of {task.name} is complex, allowed: real", remedy="leave --fields out")
    labels = torch.from_numpy(task.train.labels)
    with torch.device("cpu"):
        basis = discriminant_basis(field, labels, task.image_shape, options.fields, turned=turned)
    return torch.linalg.qr(basis).Q if options.conserving else basis


def encoder_input(task: Task, objects: Objects, profile: Profile, options: Options) -> Tensor:
    """Return what the encoder of `options` gets from `objects`, (n, inputs): transmission, field or intensity.

    With `input_photons`, fields and intensities are scaled so that the training objects bring that many on average.
    """
    flat = objects.images.reshape(len(objects), -1)
    if options.encoder == "active":
        black = profile.min_transmission
        shown = (object_transmission(profile, flat, "float32") - black) / (1 - black)
        return torch.from_numpy(shown)
    coherent = options.encoder == "coherent"
    incident = incident_field if coherent else incident_intensity
    x = torch.from_numpy(incident(objects.images, task.light, task.optics)).flatten(1)
    if options.input_photons is not None:
        scale = full_scale_photoelectrons(task, options)
        x = x * (scale**0.5 if coherent else scale)
    return x


def full_scale_photoelectrons(task: Task, options: Options) -> float:
    """Return the photoelectrons that one pixel at full scale brings to a passive encoder: 1, or what `input_photons` asks for."""
    if options.input_photons is None:
        return 1.0
    given = incident_intensity(task.train.images[:CHUNK], task.light, task.optics)
    return options.input_photons / float(given.reshape(len(given), -1).sum(axis=1).mean())
