import json

from mops_lightning.cli.schema import main
from tests.support import commands


def test_schema_is_written_or_a_mistake_is_one_line(tmp_path):
    prog = "mops-lightning schema"
    status, out, _ = commands.call(main, prog, tmp_path / "new" / "schema.json")
    assert (status, out) == (0, f"{tmp_path}/new/schema.json\n")
    assert "sampler" in json.loads((tmp_path / "new" / "schema.json").read_text())["properties"]
    (tmp_path / "file").touch()
    status, out, err = commands.call(main, prog, tmp_path / "file" / "schema.json")
    assert (status, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"{prog}: OUT: cannot write to ")
