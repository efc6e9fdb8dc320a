"""A folder of keys: one's own pair, who may come in, and whose gateways one talks to.

    secret     NAME PUBLIC SECRET          one's own pair, mode 0600
    allowed    NAME PUBLIC [GROUP,...]     whom a gateway of this user lets in; also by the number of a certificate
    trusted    HOST:PORT PUBLIC            the keys of gateways

One entry a line; lines that begin with ``#`` are comments. Keys are CURVE keys in Z85, 40 characters. The folder is of
its user alone; a file is replaced as a whole, so that who reads it finds the old or the new one. Certificates, for
Zenoh, have files of their own (``certificates``).
"""

from __future__ import annotations

import errno
import os
import re
import stat
from dataclasses import dataclass

VARIABLE = "SIOMS_KEYS"
MOST_BYTES = 1 << 20
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_KEY = re.compile(r"[0-9a-zA-Z.\-:+=^!/*?&<>()\[\]{}@%$#]{40}")
_CERTIFICATE = re.compile(r"cert-0[0-9]{3}")


@dataclass(frozen=True, slots=True)
class Pair:
    """One's own key.

    Attributes:
        name: what it was made for; the gateway's administrator may call it otherwise.
        public, secret: Z85.
    """

    name: str
    public: str
    secret: str


@dataclass(frozen=True, slots=True)
class Allowed:
    """A key that a gateway lets in: what it is called there, and its groups."""

    name: str
    public: str
    groups: tuple[str, ...] = ()


def default_folder() -> str:
    """Return $SIOMS_KEYS, else the user's own folder."""
    base = os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config")
    return os.environ.get(VARIABLE) or f"{base}/sioms/keys"


def checked_name(what: str, name: str) -> str:
    """Return the name of a key or a group; raises OSError for what is none."""
    if not _NAME.fullmatch(name):
        raise OSError(errno.EINVAL, f"{what}: {name!r}; want 1 to 64 letters, digits, - . and _")
    return name


def checked_holder(what: str, key: str) -> str:
    """Return a public key or the number of a certificate; raises OSError for what is none."""
    return key if _CERTIFICATE.fullmatch(key) else checked_key(what, key, " or cert-NNNN of `sioms cert list`")


def checked_key(what: str, key: str, other: str = "") -> str:
    """Return a public key; raises OSError for what is none."""
    if not _KEY.fullmatch(key):
        want = f"want the 40 characters of `sioms key list`{other}"
        raise OSError(errno.EINVAL, f"{what}: {key!r} is no public key; {want}")
    return key


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK | os.O_CLOEXEC)  # a pipe would hold up who reads it


class Folder:
    """A folder of keys.

    Args:
        path: of the folder, which need not be there yet.

    Raises:
        OSError: EPERM, others may look into it.
    """

    def __init__(self, path: str = "") -> None:
        self.path = path or default_folder()
        if os.path.isdir(self.path):
            self._check(self.path, 0o077)

    def _check(self, path: str, forbidden: int) -> None:
        about = os.stat(path)
        if about.st_uid not in (0, os.geteuid()):
            raise OSError(errno.EPERM, f"keys in {path}: it belongs to user {about.st_uid}; want a folder of one's own")
        if stat.S_IMODE(about.st_mode) & forbidden:
            mode = stat.S_IMODE(about.st_mode)
            right = "0700" if stat.S_ISDIR(about.st_mode) else "0600"
            raise OSError(
                errno.EPERM, f"keys in {path}: others may use it (mode {mode:04o}); run: chmod {right} {path}"
            )

    def file(self, name: str) -> str:
        """Return the path of a file of the folder."""
        return os.path.join(self.path, name)

    def check_secret(self, name: str) -> None:
        """Raise OSError, EPERM, if others may read a file."""
        self._check(self.file(name), 0o077)

    def _lines(self, name: str) -> list[list[str]]:
        path = self.file(name)
        try:
            self._check(path, 0o077 if name == "secret" else 0o022)
            with open(path, encoding="utf-8", errors="replace", opener=_at_once) as file:
                text = file.read(MOST_BYTES + 1)
        except FileNotFoundError:
            return []
        if len(text) > MOST_BYTES:
            raise OSError(errno.EFBIG, f"read {path}: more than {MOST_BYTES} characters; that is no list of keys")
        return [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]

    def _write(self, name: str, lines: list[str], mode: int) -> None:
        self.write(name, "".join(f"{line}\n" for line in lines), mode)

    def write(self, name: str, text: str, mode: int = 0o600) -> None:
        """Replace a file of the folder as a whole; raises OSError."""
        os.makedirs(self.path, mode=0o700, exist_ok=True)
        self._check(self.path, 0o077)
        made = self.file(f".{name}-{os.getpid()}")
        fd = os.open(made, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
        try:
            with open(fd, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(fd)
            os.rename(made, self.file(name))
        except BaseException:
            os.unlink(made)
            raise

    # --- one's own -------------------------------------------------------------------------------

    def own(self) -> Pair | None:
        """Return one's own key, None when there is none.

        Raises:
            OSError: EPERM others may read it; EINVAL it is damaged.
        """
        lines = self._lines("secret")
        if not lines:
            return None
        words = lines[0]
        if len(lines) != 1 or len(words) != 3 or not all(_KEY.fullmatch(word) for word in words[1:]):
            raise OSError(errno.EINVAL, f"read {self.file('secret')}: it is damaged; remove it and run: sioms key new")
        return Pair(*words)

    def new(self, name: str) -> Pair:
        """Make one's own key.

        Raises:
            OSError: EEXIST, there is one.
        """
        import zmq

        if self.own() is not None:
            raise OSError(
                errno.EEXIST,
                f"make a key in {self.path}: there is one; remove its file `secret` first if nobody is to know it",
            )
        public = "-"
        while public.startswith("-"):  # a command line would take such a key for an option
            public, secret = (key.decode() for key in zmq.curve_keypair())
        self._write("secret", [f"{checked_name('make a key', name)} {public} {secret}"], 0o600)
        return Pair(name, public, secret)

    # --- who may come in -------------------------------------------------------------------------

    def allowed(self) -> list[Allowed]:
        """Return the keys that may come in.

        Raises:
            OSError: EPERM others may write the list; EINVAL a line of it is wrong.
        """
        found = []
        for words in self._lines("allowed"):
            what = f"read {self.file('allowed')}"
            if not 2 <= len(words) <= 3:
                raise OSError(errno.EINVAL, f"{what}: a line of {len(words)} words; want NAME PUBLIC [GROUP,...]")
            groups = tuple(checked_name(what, group) for group in words[2].split(",")) if words[2:] else ()
            found.append(Allowed(checked_name(what, words[0]), checked_holder(what, words[1]), groups))
        return found

    def allow(self, name: str, public: str, groups: tuple[str, ...] = ()) -> None:
        """Let a key in, or give it other groups.

        Raises:
            OSError: EEXIST, the name is another key's, or the key has another name.
        """
        what = f"allow {name}"
        entry = Allowed(checked_name(what, name), checked_holder(what, public), groups)
        for group in groups:
            checked_name(what, group)
        others = [one for one in self.allowed() if (one.name, one.public) != (name, public)]
        for one in others:
            if one.name == name or one.public == public:
                raise OSError(
                    errno.EEXIST, f"{what}: {one.name} has {one.public} already; run first: sioms key revoke {one.name}"
                )
        self._write_allowed([*others, entry])

    def revoke(self, name: str) -> None:
        """Let a key in no more; raises OSError, ENOENT, for a name that is none."""
        allowed = self.allowed()
        left = [one for one in allowed if one.name != name]
        if len(left) == len(allowed):
            names = ", ".join(one.name for one in allowed) or "none"
            raise OSError(errno.ENOENT, f"revoke {name}: no such key in {self.file('allowed')}; there are: {names}")
        self._write_allowed(left)

    def _write_allowed(self, entries: list[Allowed]) -> None:
        self._write("allowed", [f"{one.name} {one.public} {','.join(one.groups)}".rstrip() for one in entries], 0o600)

    # --- whose gateways --------------------------------------------------------------------------

    def trusted(self) -> dict[str, str]:
        """Return the public keys of gateways by HOST:PORT; raises OSError as ``allowed``."""
        found = {}
        for words in self._lines("trusted"):
            what = f"read {self.file('trusted')}"
            if len(words) != 2:
                raise OSError(errno.EINVAL, f"{what}: a line of {len(words)} words; want HOST:PORT PUBLIC")
            found[words[0]] = checked_key(what, words[1])
        return found

    def trust(self, place: str, public: str) -> None:
        """Take a public key for that of the gateway at HOST:PORT.

        Raises:
            OSError: EEXIST, another key is trusted there.
        """
        trusted, public = self.trusted(), checked_key(f"trust {place}", public)
        if trusted.get(place, public) != public:
            raise OSError(
                errno.EEXIST,
                f"trust {place}: {trusted[place]} is trusted there; if that gateway has a new key, run first: "
                f"sioms key revoke {place}",
            )
        self._write("trusted", [f"{at} {key}" for at, key in {**trusted, place: public}.items()], 0o600)

    def distrust(self, place: str) -> bool:
        """Forget the key of a gateway; return whether there was one."""
        trusted = self.trusted()
        there = trusted.pop(place, None) is not None
        if there:
            self._write("trusted", [f"{at} {key}" for at, key in trusted.items()], 0o600)
        return there
