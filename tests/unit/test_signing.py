"""Keys and signatures: made once, checked before a file is run, never half replaced."""

import hmac

import pytest

import dengine.export.torchscript
from dengine import ModelPrediction, TraceSpec, export_torchscript, load_exported
from dengine.errors import ExportError, OutputError
from dengine.export import make_key
from dengine.export.bundle import metadata_of, read_checked, write_export
from tests.support.command_line import dengine as command


@pytest.fixture(scope="module")
def model(make_data):
    data = make_data(60, 40)
    return ModelPrediction("pca").fit(data.X, data.y)


@pytest.fixture
def key(tmp_path):
    return make_key(tmp_path / "cell.key")


def test_a_key_is_new_secret_and_never_replaced(key, tmp_path):
    kept = key.read_text()
    assert key.stat().st_mode & 0o777 == 0o600
    assert len(bytes.fromhex(kept.strip())) == 32
    assert make_key(tmp_path / "other.key").read_text() != kept
    (tmp_path / "link.key").symlink_to(tmp_path / "planted")
    for taken in (key, tmp_path / "link.key"):
        with pytest.raises(ExportError, match="File exists; name a new file"):
            make_key(taken)
    assert command("export", "--make-key", tmp_path / "nowhere" / "cell.key").exit_code == 1
    assert key.read_text() == kept
    assert not (tmp_path / "planted").exists()


def test_the_signature_is_that_of_the_standard(model, key, tmp_path):
    file = export_torchscript(model, tmp_path / "model.ts", key=key)
    expected = hmac.digest(key.read_text().strip().encode(), file.read_bytes(), "sha256").hex()
    assert (tmp_path / "model.ts.sig").read_text() == f"hmac-sha256:{expected}  model.ts\n"
    assert load_exported(file, key=key).trace == TraceSpec(40)
    again = load_exported(file, key=key).save(tmp_path / "saved.ts", key=key)
    assert metadata_of(read_checked(again, key), again)["references"] == 60


@pytest.mark.parametrize(
    "kind", ["unsigned", "another key", "changed", "a short key", "no key", "not text"]
)
def test_what_is_not_signed_with_the_key_is_refused_before_torch_sees_it(
    key, tmp_path, kind, monkeypatch
):
    file, signature = tmp_path / "model.ts", tmp_path / "model.ts.sig"
    write_export(file, b"a model", key=key)
    if kind == "unsigned":
        signature.unlink()
    elif kind == "another key":
        key = make_key(tmp_path / "other.key")
    elif kind == "changed":  # by someone who mends the sum
        text = signature.read_bytes()
        write_export(file, b"another model", force=True)
        signature.write_bytes(text)
    elif kind == "a short key":
        key.write_text("secret\n")
    elif kind == "no key":
        key.unlink()
    else:
        signature.write_bytes(b"\xff\xfe")
    loads: list[object] = []
    monkeypatch.setattr(dengine.export.torchscript.torch.jit, "load", loads.append)
    with pytest.raises(ExportError, match=r"(?i)signature|key"):
        load_exported(file, key=key)
    assert loads == []


def test_a_file_that_is_replaced_loses_its_earlier_signature(key, tmp_path):
    file, signatures = tmp_path / "model.ts", tmp_path / "model.ts.sig"
    write_export(file, b"one", key=key)
    text = signatures.read_text()
    write_export(file, b"two", force=True, key=key)
    assert signatures.read_text() != text
    write_export(file, b"four", force=True)
    assert not signatures.exists()  # it was of the file that was replaced


def test_a_signature_of_another_tool_is_not_replaced(key, tmp_path):
    custom = tmp_path / "model.ts.sig"
    custom.write_text("-----BEGIN PGP SIGNATURE-----\n")
    with pytest.raises(OutputError, match="was left as it was"):
        write_export(tmp_path / "model.ts", b"one", key=key)
    assert custom.read_text().startswith("-----BEGIN")
    assert not (tmp_path / "model.ts").exists()
