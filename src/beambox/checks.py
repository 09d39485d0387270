"""The vocabulary of errors: what was expected, what came, what to do.

Everything a user can cause is a :class:`BeamboxError`; the command line prints it as one line and exits with status 2.
Plain ``assert`` is kept for our own invariants.
"""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import fields
from enum import Enum
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

if TYPE_CHECKING:  # the command line imports this module before it knows whether torch is needed
    import torch
    from torch import Tensor

__all__ = [
    "BeamboxError",
    "MissingFileError",
    "choose_fields",
    "chosen",
    "did_you_mean",
    "expect_dtype",
    "expect_finite",
    "expect_library",
    "expect_one_of",
    "expect_same_length",
    "expect_shape",
    "how_to_install",
    "import_library",
    "lacking",
    "printable",
]


LONGEST_WORD = 200
"""No name is looked up by likeness that has more letters: it is no typing error, and comparing takes long."""


LONGEST_MESSAGE = 1500
"""Characters of an error's message: names in files have any length, and the middle of what quotes them is left out."""


class BeamboxError(ValueError):
    """Something the user gave cannot be used; the message says what was expected, what came and what to do."""

    def __init__(self, *parts: object) -> None:
        super().__init__(*(_shortened(part, LONGEST_MESSAGE) if isinstance(part, str) else part for part in parts))


class MissingFileError(BeamboxError, FileNotFoundError):
    """A file or folder that was asked for, or that a format requires, is not there."""

    def __str__(self) -> str:  # FileNotFoundError formats (errno, text); one plain sentence is wanted
        """Return the message as it was given."""
        return str(self.args[0]) if self.args else ""


def expect_shape(name: str, tensor: Tensor, shape: Sequence[int | str | None]) -> None:
    """Check the shape of a tensor.

    Args:
        name: what the tensor is called in the message.
        tensor: the tensor to check.
        shape: one entry a dimension; an ``int`` must match, a ``str`` (a name for the message) or ``None`` may be any.

    Raises:
        BeamboxError: if the number of dimensions or a fixed dimension differs.
    """
    fits = tensor.dim() == len(shape) and all(
        not isinstance(want, int) or want == have for want, have in zip(shape, tensor.shape)
    )
    if not fits:
        wanted = ", ".join("any" if s is None else str(s) for s in shape)
        raise BeamboxError(f"`{name}` must have shape ({wanted}), got {tuple(tensor.shape)}")


def expect_dtype(name: str, tensor: Tensor, *dtypes: torch.dtype) -> None:
    """Check that a tensor has one of the given element types."""
    if tensor.dtype not in dtypes:
        wanted = " or ".join(str(d).removeprefix("torch.") for d in dtypes)
        raise BeamboxError(f"`{name}` must be {wanted}, got {str(tensor.dtype).removeprefix('torch.')}")


def expect_finite(name: str, tensor: Tensor) -> None:
    """Check that a tensor holds neither NaN nor infinity."""
    bad = int((~tensor.isfinite()).sum())
    if bad:
        raise BeamboxError(f"`{name}` must be finite, got {bad} NaN or infinite values of {tensor.numel()}")


def expect_same_length(**lengths: int) -> None:
    """Check that several sequences, given as ``name=len(sequence)``, have one length."""
    if len(set(lengths.values())) > 1:
        details = ", ".join(f"`{name}` has {n}" for name, n in lengths.items())
        raise BeamboxError(f"these must have the same length: {details}")


E = TypeVar("E", bound=Enum)


def chosen(name: str, value: object, options: type[E]) -> E:
    """Return the member of an enumeration that a value is, or whose value it is.

    Args:
        name: what the option is called in the message.
        value: a member, or its value, such as ``"sigmoid"``.
        options: the enumeration.

    Raises:
        BeamboxError: for anything else, naming the nearest.
    """
    if isinstance(value, options):
        return value
    words = [str(option.value) for option in options]
    if isinstance(value, str) and value in words:
        return options(value)
    raise _no_option(name, value, words)


def expect_one_of(name: str, value: object, options: Sequence[str]) -> None:
    """Check that a word is one of those an option knows."""
    if value not in options:
        raise _no_option(name, value, options)


def _no_option(name: str, value: object, words: Sequence[str]) -> BeamboxError:
    hint = did_you_mean(value, words) if isinstance(value, str) else f" (known: {', '.join(sorted(words))})"
    return BeamboxError(f"`{name}` must be one of its options, got {value!r}{hint}")


def choose_fields(settings: Any) -> None:
    """Turn the words in a frozen dataclass's enumeration fields into members; to be called in ``__post_init__``.

    Raises:
        BeamboxError: for a word that the field's enumeration does not know.
    """
    hints = get_type_hints(type(settings))
    for field in fields(settings):
        kind = hints[field.name]
        if isinstance(kind, type) and issubclass(kind, Enum):
            object.__setattr__(settings, field.name, chosen(field.name, getattr(settings, field.name), kind))


def did_you_mean(word: str, options: Iterable[str]) -> str:
    """Return `` (did you mean "x"?)`` for the nearest option, or the list of options where none is near."""
    known = sorted(str(option)[:LONGEST_WORD] for option in options)
    near = [] if len(word) > LONGEST_WORD else difflib.get_close_matches(word, known[:1000], n=1, cutoff=0.6)
    if near:
        return f' (did you mean "{near[0]}"?)'
    more = f" and {len(known) - 40} more" if len(known) > 40 else ""
    return f" (known: {', '.join(known[:40])}{more})" if known else ""


def printable(text: str, limit: int | None = None) -> str:
    r"""Return text that a terminal and a picture can show: what would steer a terminal is written as an escape.

    Names and messages come from files, and ``\x1b[2J`` in one of them would otherwise clear the screen.

    Args:
        text: anything.
        limit: longest result in characters; the middle of longer texts is left out, and their length said.
    """
    if limit is not None:
        text = _shortened(text, limit)
    if text.replace("\n", "").replace("\t", "").isprintable():
        return text
    return "".join(
        letter if letter.isprintable() or letter in "\n\t" else letter.encode("unicode_escape").decode()
        for letter in text
    )


def _shortened(text: str, limit: int) -> str:
    """Leave out the middle of a text that is longer than ``limit``, and say its length there."""
    if len(text) <= limit:
        return text
    half = max(1, limit // 2 - 20)
    return f"{text[:half]} ... ({len(text):,} characters) ... {text[-half:]}"


def expect_library(name: str, extra: str, what: str) -> None:
    """Refuse to begin what needs an optional library that is absent.

    Args:
        name: of its module.
        extra: of beambox, which installs it.
        what: needs it, for the message.
    """
    if importlib.util.find_spec(name) is None:
        raise lacking(name, extra, what)


def import_library(name: str, extra: str, what: str, otherwise: str = "") -> Any:
    """Import an optional library, or a module of one.

    Args:
        name: of the module.
        extra: of beambox, which installs it.
        what: needs it, for the message.
        otherwise: what one can do without it.

    Raises:
        BeamboxError: with the command that installs it, where it is absent.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise lacking(name, extra, what, otherwise) from None


def lacking(name: str, extra: str, what: str, otherwise: str = "") -> BeamboxError:
    """Return the error of an absent library; arguments as of :func:`import_library`."""
    library = name.partition(".")[0].replace("_", "-")
    hint = f"; {otherwise}" if otherwise else ""
    return BeamboxError(f"{what} needs the library {library}, which is not installed: {how_to_install(extra)}{hint}")


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra of beambox, which no index holds: from its checkout."""
    return f'python -m pip install ".[{extra}]" in the checkout of beambox'
