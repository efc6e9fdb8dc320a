"""``sioms service``: put unit, user, folders, port names, manual pages and completions in place, and take them away
again.

What it would do to a file is decided first, for all of them (``plan``), so that a refusal leaves nothing half done.
"""

from __future__ import annotations

import argparse
import errno
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sioms.whole_file import write_whole

TOOLS = ("sioms", "siomsd", "devin", "devout", "sdev", "smarkers")
UNSEEN = ("home", "root", "run/user", "tmp", "var/tmp")
"""Folders that the unit's ProtectHome and PrivateTmp hide from the service."""
CONFIG = "etc/sioms/workcell.toml"
_BIN = "/opt/sioms/bin/"


@dataclass(frozen=True, slots=True)
class Item:
    """A file to be put in place.

    Attributes:
        target: where to, relative to the root folder.
        text: its content; '' for a link.
        link: where a link leads, '' for a file.
        mode: of a file.
        kept: somebody edits it: not removed, and never overwritten.
    """

    target: str
    text: str = ""
    link: str = ""
    mode: int = 0o644
    kept: bool = False

    def is_there(self, root: Path) -> bool:
        """Whether it is in place already, as it would be made."""
        path = root / self.target
        if self.link:
            return path.is_symlink() and os.readlink(path) == self.link
        return path.is_file() and path.read_text(encoding="utf-8") == self.text

    def put(self, root: Path) -> None:
        """Make it, in one step."""
        path = root / self.target
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = path.with_name(f".{path.name}.new")
        fresh.unlink(missing_ok=True)
        try:
            if self.link:
                fresh.symlink_to(self.link)
            else:
                write_whole(fresh, self.text)
                fresh.chmod(self.mode)
            fresh.replace(path)
        finally:
            fresh.unlink(missing_ok=True)


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser("service", help="install the daemon as a service of this machine")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    for name, text in (
        ("install", "install all files"),
        ("remove", "remove all files except the configuration"),
    ):
        one = actions.add_parser(name, help=text)
        one.add_argument(
            "--root", metavar="FOLDER", type=Path, default=Path("/"), help="instead of /, and start nothing"
        )
        one.add_argument("--dry-run", action="store_true", help="print the steps without executing them")
        if name == "install":
            one.add_argument("--force", action="store_true", help="overwrite modified files")


def run(args: argparse.Namespace) -> int:
    """Install or remove; return the exit status."""
    items = list(plan(shared(), Path(sys.prefix)))
    if not args.dry_run and args.root == Path("/") and os.geteuid() != 0:
        raise OSError(
            errno.EPERM,
            f"{args.action} the service: it writes to /etc; run it as root, or with --dry-run to see what",
        )
    if not args.root.is_dir():
        raise OSError(
            errno.ENOENT,
            f"{args.action} the service: --root {args.root}: no such folder; make it, or name another",
        )
    if args.action == "install":
        _refuse_unseen(args.root)
        return _install(items, args.root, args.dry_run, args.force)
    return _remove(items, args.root, args.dry_run)


# --- what belongs where ------------------------------------------------------------------------------


def shared() -> Path:
    """Return the folder that holds ``etc`` and ``docs/man`` as the tree does.

    Raises:
        OSError: the installation has lost it.
    """
    tree = Path(__file__).resolve().parent.parent
    installed = Path(sysconfig.get_path("data")) / "share" / "sioms"
    for folder in (tree, installed):
        if (folder / "etc" / "sioms.service").is_file():
            return folder
    raise OSError(
        errno.ENOENT,
        f"find the files of the service: neither {tree} nor {installed} has etc/sioms.service; install again",
    )


def plan(source: Path, prefix: Path) -> Iterator[Item]:
    """Yield everything that belongs into the system.

    Args:
        source: folder with ``etc`` and ``docs/man``.
        prefix: environment whose programs the service runs.
    """
    etc = source / "etc"

    def text(path: Path) -> str:
        return path.read_text(encoding="utf-8")

    unit = text(etc / "sioms.service").replace(_BIN, f"{prefix}/bin/")
    yield Item("etc/systemd/system/sioms.service", unit)
    yield Item("etc/sysusers.d/sioms.conf", text(etc / "sysusers.d" / "sioms.conf"))
    yield Item("etc/tmpfiles.d/sioms.conf", text(etc / "tmpfiles.d" / "sioms.conf"))
    yield Item("etc/udev/rules.d/60-sioms.rules", text(etc / "udev" / "60-sioms.rules"), kept=True)
    for page in sorted((source / "docs" / "man").glob("*.[18]")):
        yield Item(f"usr/local/share/man/man{page.suffix[1:]}/{page.name}", text(page))
    completions = "usr/local/share/bash-completion/completions"
    yield Item(f"{completions}/sioms", text(etc / "completion" / "sioms.bash"))
    for tool in TOOLS:
        if tool != "sioms":
            yield Item(f"{completions}/{tool}", link="sioms")
        yield Item(f"usr/local/bin/{tool}", link=f"{prefix}/bin/{tool}")
    yield Item("usr/local/share/zsh/site-functions/_sioms", text(etc / "completion" / "_sioms"))
    yield Item("usr/local/share/fish/vendor_completions.d/sioms.fish", text(etc / "completion" / "sioms.fish"))
    here = Path(__file__).parent
    starter = text(here / "starter.toml").replace("{name}", "workcell") + text(here / "starter_simulated.toml")
    yield Item(CONFIG, starter, mode=0o640, kept=True)


def _refuse_unseen(root: Path) -> None:
    """Refuse an environment that the service could not see, before anything is written."""
    prefix = Path(sys.prefix).resolve()
    hidden = [folder for folder in UNSEEN if prefix.is_relative_to(f"/{folder}")]
    if hidden and root == Path("/"):
        raise OSError(
            errno.EINVAL,
            f"install the service: its programs are in {prefix}, and the service does not see /{hidden[0]}; "
            "install SIOMS into /opt/sioms (docs/install.md) and run that one's `sioms service install`",
        )
    if " " in str(prefix):
        raise OSError(
            errno.EINVAL,
            f"install the service: {prefix} contains a space, at which systemd's ExecStart would split it",
        )


# --- carrying it out ------------------------------------------------------------------------------------


def _install(items: list[Item], root: Path, dry_run: bool, force: bool) -> int:
    changed = [i for i in items if _is_other(i, root) and not (force and not i.kept) and not _is_ours(i, root)]
    for item in items:
        where = root / item.target
        if item.is_there(root):
            print(f"in place   {where}")
        elif item in changed:
            print(f"kept       {where}: it differs{'' if item.kept else '; --force overwrites it'}")
        else:
            print(f"{'would put' if dry_run else 'put':<10} {where}")
            if not dry_run:
                item.put(root)
    if root == Path("/"):
        _carry_out(
            dry_run,
            ("systemd-sysusers",), ("systemd-tmpfiles", "--create", "sioms.conf"), ("chgrp", "sioms", f"/{CONFIG}"),
            ("systemctl", "daemon-reload"), ("udevadm", "control", "--reload"),
        )  # fmt: skip
        print(
            f"next: edit /{CONFIG}, `sioms check /{CONFIG}`, `systemctl enable --now sioms`; `usermod -aG sioms USER` "
            "lets a user in"
        )
    return 0


def _remove(items: list[Item], root: Path, dry_run: bool) -> int:
    if root == Path("/"):
        _carry_out(dry_run, ("systemctl", "disable", "--now", "sioms"))
    for item in items:
        path = root / item.target
        if not path.exists() and not path.is_symlink():
            continue
        if item.kept or not item.is_there(root):
            print(f"kept       {path}: {'yours' if item.kept else 'it differs from what was installed'}")
            continue
        print(f"{'would remove' if dry_run else 'removed':<10} {path}")
        if not dry_run:
            path.unlink()
    if root == Path("/"):
        _carry_out(dry_run, ("systemctl", "daemon-reload"))
    return 0


def _is_other(item: Item, root: Path) -> bool:
    path = root / item.target
    return (path.exists() or path.is_symlink()) and not item.is_there(root)


def _is_ours(item: Item, root: Path) -> bool:
    """Whether a link that differs leads to another environment's tool of the same name, or to one that is gone."""
    path = root / item.target
    return bool(item.link) and path.is_symlink() and Path(os.readlink(path)).name == Path(item.link).name


def _carry_out(dry_run: bool, *commands: tuple[str, ...]) -> None:
    """Run what there is of these programs; a failure is told and ends nothing."""
    for command in commands:
        if shutil.which(command[0]) is None:
            print(f"left out   {' '.join(command)}: no such program on this machine")
            continue
        print(f"{'would run' if dry_run else 'run':<10} {' '.join(command)}")
        if dry_run:
            continue
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            print(f"failed     {' '.join(command)}: {(done.stderr or done.stdout).strip()}", file=sys.stderr)
