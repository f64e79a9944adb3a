from pathlib import Path

import pytest

from structuregs.files import replace_file, replacing


def names(folder: Path) -> set[str]:
    return {str(file.relative_to(folder)) for file in folder.rglob("*")}


def test_a_file_takes_its_place_when_it_is_whole(tmp_path: Path):
    file = tmp_path / "new" / "table.json"
    with replacing(file) as staged:
        staged.write_text("half")
        assert staged.suffix == ".json", "writers that go by the ending"
        assert not file.exists()
        staged.write_text("whole")
    assert names(tmp_path) == {"new", "new/table.json"}
    assert file.read_text() == "whole"
    assert replace_file(file, b"\x00again") == file
    assert file.read_bytes() == b"\x00again"


@pytest.mark.parametrize("error", [OSError, KeyboardInterrupt])
def test_what_is_interrupted_leaves_the_old_file_and_nothing_else(tmp_path: Path, error: type[BaseException]):
    file = replace_file(tmp_path / "table.md", "before")

    def write():
        with replacing(file) as staged:
            staged.write_text("half of")
            raise error

    with pytest.raises(error):
        write()
    assert names(tmp_path) == {"table.md"}
    assert file.read_text() == "before"
