"""No output ever destroys a file: checks before a command begins, exclusive creation, whole files or none."""

import os
import stat
from pathlib import Path
from typing import Any

import pytest

from pans.base.errors import UsageError
from pans.base.files import output_files as outputs
from pans.base.files.output_files import (
    check_outputs,
    file_identity,
    lock_is_held,
    locked,
    new_run_folder,
    own_folder,
    place_new,
    whole_file,
    write_file,
)


@pytest.fixture
def old(tmp_path: Path) -> Path:
    path = tmp_path / "old"
    path.write_bytes(b"precious")
    return path


def listing(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


def test_an_existing_file_stays_unless_forced(old: Path) -> None:
    for refused in (lambda: check_outputs([old]), lambda: write_file(old, b"new")):
        with pytest.raises(UsageError, match=r"exists already\n.*--force"):
            refused()
    assert old.read_bytes() == b"precious"
    check_outputs([old], force=True)
    check_outputs([old], ours=lambda path: path.read_bytes() == b"precious")
    write_file(old, b"new", force=True)
    assert old.read_bytes() == b"new"
    assert listing(old.parent) == ["old"]


def test_a_file_survives_a_power_cut_and_then_its_name_does(tmp_path: Path, synced: dict[int, Any]) -> None:
    write_file(path := tmp_path / "new", b"precious")
    assert list(synced.items()) == [(path.stat().st_ino, 8), (tmp_path.stat().st_ino, {"new"})]


def test_an_output_is_never_an_input_by_whatever_name(old: Path) -> None:
    folder = old.parent
    (folder / "symlink").symlink_to(old)
    (folder / "folder").symlink_to(folder)
    os.link(old, folder / "hard link")
    for name in ("old", "symlink", "hard link", "folder/old", f"./../{folder.name}/old"):
        with pytest.raises(UsageError, match="is the input"):
            check_outputs([folder / name], inputs=[None, old, folder / "none"], force=True)
        assert file_identity(folder / name) == file_identity(old)


def test_two_outputs_in_one_file_are_refused_even_before_it_exists(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(UsageError, match="is also the output"):
        check_outputs([tmp_path / "a" / "new", tmp_path / "link" / "a" / "new"], makes_folders=True)


def test_links_are_not_written_through(old: Path) -> None:
    link, dangling = old.with_name("link"), old.with_name("dangling")
    link.symlink_to(old)
    dangling.symlink_to(old.with_name("nothing"))
    for path in (link, dangling):
        for refused in (lambda path: check_outputs([path]), lambda path: write_file(path, b"new")):
            with pytest.raises(UsageError, match="exists already"):
                refused(path)
    write_file(link, b"new", force=True)
    assert (old.read_bytes(), link.read_bytes(), link.is_symlink()) == (b"precious", b"new", False)


def test_folders_devices_and_loops_are_no_outputs(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path in (tmp_path, tmp_path / "fifo", tmp_path / "loop", tmp_path / "loop" / "x", Path("/dev/full")):
        with pytest.raises(UsageError):
            check_outputs([path], force=path.name != "loop")


@pytest.mark.parametrize("where", ["none/x", "old/x", "old/x/y", "a" * 300])
def test_impossible_folders_are_refused(old: Path, where: str) -> None:
    with pytest.raises(UsageError):
        check_outputs([old.parent / where], makes_folders=where != "none/x")
    assert listing(old.parent) == ["old"]


def test_a_folder_that_cannot_be_written_to_is_found_before(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be written to"):
        check_outputs(["/proc/self/x"])
    check_outputs([tmp_path / "a" / "b" / "c"], makes_folders=True)
    assert listing(tmp_path) == []


@pytest.mark.parametrize("force", [False, True])
def test_a_failed_file_leaves_nothing_and_the_old_one_stays(old: Path, force: bool) -> None:
    target = old if force else old.with_name("new")
    with pytest.raises(UsageError, match="No space left"), whole_file(target, force=force) as beside:
        beside.write_bytes(b"half")
        raise OSError(28, "No space left on device")
    with pytest.raises(KeyError), whole_file(target, force=force):
        raise KeyError
    assert listing(old.parent) == ["old"]
    assert old.read_bytes() == b"precious"


def test_who_comes_first_wins(tmp_path: Path) -> None:
    target = tmp_path / "x"
    with pytest.raises(UsageError, match="exists already"), whole_file(target) as beside:
        beside.write_bytes(b"late")
        target.write_bytes(b"early")
    assert target.read_bytes() == b"early"
    assert listing(tmp_path) == ["x"]


def test_exclusive_renaming_without_hard_links(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(source: object, target: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(outputs.os, "link", no_links)
    beside = old.with_name("beside")
    beside.write_bytes(b"new")
    with pytest.raises(FileExistsError):
        place_new(beside, old)
    place_new(beside, old.with_name("free"))
    assert old.read_bytes() == b"precious"
    assert listing(old.parent) == ["free", "old"]


def test_run_folders_are_new_and_latest_follows(tmp_path: Path) -> None:
    made = [new_run_folder("fashion/../10 x", tmp_path / "runs") for _ in range(3)]
    assert len(set(made)) == 3
    assert all(folder.parent == tmp_path / "runs" and not listing(folder) for folder in made)
    assert (tmp_path / "runs" / "latest").resolve() == made[-1].resolve()
    assert made[0].name.endswith("-fashion-..-10-x")
    (tmp_path / "runs" / "latest").unlink()
    (tmp_path / "runs" / "latest").mkdir()  # somebody's own
    new_run_folder("y", tmp_path / "runs")
    assert not (tmp_path / "runs" / "latest").is_symlink()


def test_a_lock_names_its_holder_and_is_free_afterwards(tmp_path: Path) -> None:
    path = tmp_path / ".lock"
    with locked(path):
        with pytest.raises(UsageError, match=f"process {os.getpid()}"), locked(path):
            pytest.fail("held twice")
        assert path.exists()
    with locked(path):
        pass
    assert listing(tmp_path) == []


@pytest.mark.parametrize("make", [Path.symlink_to, Path.hardlink_to])
def test_a_lock_is_never_another_file(make, tmp_path):
    precious, lock = tmp_path / "precious", tmp_path / ".pans-run.lock"
    precious.write_text("kept")
    make(lock, precious)
    with pytest.raises(UsageError, match=r"lock: cannot be locked: (is a link|is no lock file)"), locked(lock):
        pass
    assert precious.read_text() == "kept"
    assert lock_is_held(lock)


def test_a_link_to_nowhere_makes_no_file(tmp_path):
    (tmp_path / "lock").symlink_to(tmp_path / "new")
    with pytest.raises(UsageError, match="is a link"), locked(tmp_path / "lock"):
        pass
    assert not (tmp_path / "new").exists()


def test_a_pipe_in_place_of_a_lock_holds_nobody_up(tmp_path):
    os.mkfifo(tmp_path / "lock")
    with pytest.raises(UsageError, match="is no lock file"), locked(tmp_path / "lock"):
        pass
    assert lock_is_held(tmp_path / "lock")


def test_whose_lock_is_held_is_known(tmp_path):
    assert not lock_is_held(tmp_path / "lock")
    (tmp_path / "lock").touch()
    assert not lock_is_held(tmp_path / "lock")
    with locked(tmp_path / "lock"):
        assert lock_is_held(tmp_path / "lock")


@pytest.mark.parametrize("mode", [0o777, 0o757])
@pytest.mark.parametrize("above", [".", ".."])
def test_a_folder_that_others_could_replace_is_not_ones_own(above, mode, tmp_path):
    folder = tmp_path / "cache" / "pans" / "core"
    assert own_folder(folder) == folder
    assert folder.stat().st_mode & 0o777 == 0o700
    parent = (folder.parent / above).resolve()
    parent.chmod(mode)
    with pytest.raises(PermissionError, match=f"could be replaced by others: {parent} "):
        own_folder(folder)
    parent.chmod(mode | stat.S_ISVTX)  # as /tmp
    assert own_folder(folder) == folder


def test_links_above_ones_own_folder_are_followed_first(tmp_path):
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    (tmp_path / "open" / "cache").mkdir()
    (tmp_path / "cache").symlink_to(tmp_path / "open" / "cache")
    with pytest.raises(PermissionError, match="could be replaced"):
        own_folder(tmp_path / "cache" / "core")


@pytest.mark.skipif(os.geteuid() != 0, reason="a folder is given away by root alone")
def test_a_folder_below_that_of_another_user_is_not_ones_own(tmp_path):
    (tmp_path / "theirs").mkdir()
    os.chown(tmp_path / "theirs", 12345, -1)
    with pytest.raises(PermissionError, match="is another user's"):
        own_folder(tmp_path / "theirs" / "core")
