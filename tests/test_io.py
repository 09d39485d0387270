"""Whole files: encodings, JSON and YAML that mean harm, names that lead elsewhere, writing all or nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from beambox import file_names, io
from beambox.checks import BeamboxError, MissingFileError


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("Käfer 1 2\n".encode("utf-16"), "UTF-16"),
        ("Car 1 2\n".encode("utf-16-le"), "UTF-16"),
        ("Car 1 2\n".encode("utf-16-be"), "UTF-16"),
        ("Car 1 2\n".encode("utf-32"), "UTF-32"),
        ("Car\nKäfer\n".encode("latin-1"), "line 2 holds the byte 0xe4"),
        (b"Car 1\0 2\n", "zero bytes"),
        (bytes(range(256)), "binary"),
    ],
)
def test_other_encodings_are_refused_by_name(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "labels.txt"
    path.write_bytes(content)
    with pytest.raises(BeamboxError, match=expected) as caught:
        io.read_text(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_a_byte_order_mark_is_passed_over(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("000123\n", encoding="utf-8-sig")
    assert io.read_text(tmp_path / "a.txt") == "000123\n"
    assert file_names.read_names(tmp_path / "a.txt") == ["000123"]
    (tmp_path / "a.json").write_text('{"a": 1}', encoding="utf-8-sig")
    assert io.read_json(tmp_path / "a.json") == {"a": 1}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[" * 100_000, "nested too deeply"),
        ("[1" + "0" * 5000 + "]", "beyond what a float can hold"),
        ("[1e999]", "beyond what a float can hold"),
        ("[NaN]", "got NaN"),
        ("[-Infinity]", "got -Infinity"),
        ('{"a": }', "not valid JSON"),
        ("", "not valid JSON"),
    ],
)
def test_json_is_finite_and_shallow(text: str, expected: str) -> None:
    with pytest.raises(BeamboxError, match=expected) as caught:
        io.parse_json(text, "boxes.json")
    assert str(caught.value).startswith("boxes.json") and len(str(caught.value)) < 200


def test_integers_of_twenty_digits_become_floats() -> None:
    assert io.parse_json("[123456789012345678, 12345678901234567890]", "a") == [
        123456789012345678,
        1.2345678901234567e19,
    ]


BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{n}: &{n} [{','.join(['*' + p] * 9)}]\n" for p, n in zip("abcdefgh", "bcdefghi")
)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (BOMB, "aliases multiply"),
        ("a: &a [*a]", "aliases multiply"),
        ("a: " + "[" * 5000, "nested too deeply"),
        ("a: 2026-13-45", "not valid YAML"),
        ("a: 1" + "0" * 5000, "not valid YAML"),
        ("a: !!python/object/apply:os.system [id]", "not valid YAML"),
        ("a: !!int x", "not valid YAML"),
        ("a: !!timestamp x", "not valid YAML"),
        ("? [1]\n: 2", "not valid YAML"),
        ("a: 1\nb: 2\na: 3", "'a' stands here twice"),
    ],
)
def test_yaml_is_plain_and_small(text: str, expected: str) -> None:
    before = time.process_time()
    with pytest.raises(BeamboxError, match=expected) as caught:
        io.parse_yaml(text, "recipe.yaml")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    assert time.process_time() - before < 2


def test_yaml_aliases_that_do_not_multiply_are_read() -> None:
    assert io.parse_yaml("a: &a {x: 1}\nb: {<<: *a, y: 2}", "r") == {"a": {"x": 1}, "b": {"x": 1, "y": 2}}


@pytest.mark.parametrize(
    "name",
    ["../x", "a/b", "a\\b", "..", ".", "", " ", "a\nb", "a\x1b[31m", "a\0", "x" * 300, "/etc/passwd", "\udcff", 7],
)
def test_names_that_are_no_file_names_are_refused(name: object) -> None:
    with pytest.raises(BeamboxError, match=r"list\.txt: a name must be") as caught:
        file_names.check_file_name(name, "list.txt")
    assert "\x1b" not in str(caught.value) and "\n" not in str(caught.value) and len(str(caught.value)) < 250


@pytest.mark.parametrize("name", ["000123", "n015-2018__LIDAR_TOP__15318.pcd", "2026-01-01 12.00", "Straße", "..a"])
def test_plain_names_pass(name: str) -> None:
    assert file_names.check_file_name(name, "list.txt") == name


def test_lists_name_each_frame_once_and_stay_in_their_folder(tmp_path: Path) -> None:
    for text, expected in (("", "is empty"), ("1 2 1", "names 1 again"), ("1\n../2", "plain file name")):
        (tmp_path / "val.txt").write_text(text, encoding="utf-8")
        with pytest.raises(BeamboxError, match=expected):
            file_names.read_names(tmp_path / "val.txt")
    with pytest.raises(MissingFileError):
        file_names.read_names(tmp_path / "none.txt")


def test_a_failure_while_writing_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    io.write_text(path, "old")
    with pytest.raises(RuntimeError), io.replacing(path) as stream:
        stream.write(b"new")
        raise RuntimeError
    assert path.read_text(encoding="utf-8") == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_json_with_nan_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(BeamboxError, match="finite"):
        io.write_json(tmp_path / "a.json", {"a": float("nan")})
    assert not list(tmp_path.iterdir())


def test_folders_and_places_that_are_none_are_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    for path in (tmp_path, tmp_path / "file" / "a.txt"):
        with pytest.raises(BeamboxError, match="cannot write"):
            io.write_text(path, "x")


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="no devices of Unix here")
def test_devices_are_written_to_not_replaced() -> None:
    io.write_text(Path("/dev/null"), "x")
    assert not Path("/dev/null").is_file()


def test_files_get_the_permissions_that_the_umask_gives(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    io.write_text(tmp_path / "ours", "x")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.skipif(os.name == "nt", reason="needs SIGKILL")
def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path: Path) -> None:
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom beambox.io import replacing\n"
        "with replacing(Path(sys.argv[1])) as stream:\n"
        "    stream.write(b'half'); stream.flush(); print('writing', flush=True); time.sleep(60)\n"
    )
    path = tmp_path / "last.safetensors"
    writers = [
        subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, env={**os.environ})
        for _ in "ab"
    ]
    try:
        for writer in writers:
            assert writer.stdout is not None and writer.stdout.readline() == b"writing\n"
        assert len(list(tmp_path.iterdir())) == 2
        writers[0].send_signal(signal.SIGKILL)
        writers[0].wait()
        io.write_bytes(path, b"whole", sync=True)
        assert path.read_bytes() == b"whole"
        assert len(list(tmp_path.iterdir())) == 2, "the draft of the writer that lives stays"
    finally:
        for writer in writers:
            writer.kill()
            writer.wait()
    io.write_bytes(path, b"whole", sync=True)
    assert os.listdir(tmp_path) == ["last.safetensors"]


def test_drafts_of_former_versions_go_and_other_hidden_files_stay(tmp_path: Path) -> None:
    for name in (
        ".last.safetensors.x7_k2abc",
        ".a.json.k2j4h6g8.part",
        ".last.safetensors.original",
        ".profile",
        ".b.part",
    ):
        (tmp_path / name).touch()
    io.write_text(tmp_path / "a", "x")
    assert sorted(os.listdir(tmp_path)) == [".b.part", ".last.safetensors.original", ".profile", "a"]


def test_no_module_writes_past_the_one_writer() -> None:
    """Four writers with different rules became one; a fifth is refused here."""
    source = Path(io.__file__).parent
    marks = ("os.replace(", "mkstemp(", "NamedTemporaryFile(", ".write_text(", ".write_bytes(")
    found = [
        f"{path.relative_to(source)}: {mark}"
        for path in sorted(source.rglob("*.py"))
        for mark in marks
        if path.name != "io.py" and mark in path.read_text(encoding="utf-8")
    ]
    assert not found


@pytest.mark.parametrize(
    "name",
    [
        "Car",
        "my car",
        "",
        "#1",
        "DontCare",
        "dontcare",
        "50% off",
        "a%20b",
        "%",
        "%00",
        "Straße",
        "汽车",
        "a\tb\n",
        "\x1b[31m",
        " x ",
    ],
)
def test_names_of_classes_survive_text_files(name: str) -> None:
    word = file_names.name_to_word(name)
    assert word.split() == [word] and word.isprintable() and not word.startswith("#") and word.lower() != "dontcare"
    assert file_names.word_to_name(word) == name
    assert file_names.name_to_word("Car") == "Car" and file_names.word_to_name("100%ABC") == "100%ABC"


def test_an_error_that_quotes_a_file_stays_short() -> None:
    error = BeamboxError(f'unknown class "{"9" * 5000}" (known: Car)')
    assert len(str(error)) < 1600
    assert str(error).startswith('unknown class "999') and str(error).endswith("(known: Car)")
    assert "(5,029 characters)" in str(error)
