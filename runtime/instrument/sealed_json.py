"""A file of measured facts: strict JSON with a checksum over everything in it, and what every such file says of its instrument.

Owns the checksum, the words about a file that was altered, and the comparison with profile and device; what a file holds is its owner's
(calibration.py, registration).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from pans.runtime.container import canonical_json, parse_json_object
from pans.runtime.errors import ConfigError, DamagedFileError

from .profile import Profile


def sealed(values: Mapping[str, Any], format_name: str, version: int) -> bytes:
    """Return the file's bytes: `values` (JSON-able) with format, version and checksum."""
    body = {"format": format_name, "version": version, **values}
    whole = {**body, "sha256": hashlib.sha256(canonical_json(body)).hexdigest()}
    return (json.dumps(whole, indent=1, sort_keys=True, allow_nan=False) + "\n").encode()


def unsealed(data: bytes, where: str, format_name: str, version: int) -> dict[str, Any]:
    """Return what the bytes of a file hold; DamagedFileError for another format, or where the checksum does not fit."""
    values = parse_json_object(data, where)
    if values.get("format") != format_name or values.get("version") != version:
        found = f"{ascii(values.get('format'))[:40]} {ascii(values.get('version'))[:20]}"
        raise DamagedFileError(f"{where}: format {found}, allowed: {format_name} {version}")
    body = {key: value for key, value in values.items() if key != "sha256"}
    if values.get("sha256") != hashlib.sha256(canonical_json(body)).hexdigest():
        raise DamagedFileError(f"{where}: altered: its checksum does not fit what it says", remedy="calibrate again")
    return values


def check_made_for(where: str, values: Mapping[str, Any], profile: Profile, serial: str | None, command: str) -> None:
    """Raise ConfigError if the file is of another profile or, where the device has told its serial number, of another device."""
    made_for = values["profile"]
    if made_for["sha256"] != profile.sha256:
        raise ConfigError(
            f"{where}: made for the profile {made_for['name']} ({made_for['sha256'][:12]}…), this run uses {profile.name} "
            f"({profile.sha256[:12]}…)",
            remedy=f"calibrate with this profile: {command} --profile {profile.name}",
        )
    of_device = values["device"].get("serial")
    if serial is not None and of_device is not None and of_device != serial:
        raise ConfigError(f"{where}: made on the device {of_device}, this is {serial}", remedy="calibrate this device")
