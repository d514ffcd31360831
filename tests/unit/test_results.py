"""The published results are whole; `training/list_figures.py` compares the pages with them."""

import hashlib
import json


def test_each_published_file_of_the_evidence_is_the_one_that_its_manifest_names(repo):
    manifest = json.loads((repo / "docs" / "results" / "manifest.json").read_text("utf-8"))
    assert manifest["parts"]
    for name, part in manifest["parts"].items():
        for file, digest in part["files"].items():
            content = (repo / file).read_bytes()
            assert hashlib.sha256(content).hexdigest() == digest, f"{file} is not of {name}"
