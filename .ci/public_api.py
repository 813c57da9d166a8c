"""The library's public interface, read from rustdoc's JSON, compared with .ci/public-api.txt.

Lists each name that `foreframe` re-exports with its fields, variants and methods. Fails if the list differs from the file,
if a signature names a type of the tensor library, or one of our types that `foreframe` does not re-export.

    python3 .ci/public_api.py            compare
    python3 .ci/public_api.py --update   write the file
"""

import difflib
import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SNAPSHOT = ROOT / ".ci" / "public-api.txt"
CRATES = ["core", "sim", "data", "train"]
# The most names without features, and with all.
MOST_BARE, MOST_ALL = 60, 155
FORBIDDEN = "candle"


def write_documents():
    """The JSON of all packages, by one run of cargo with the features of the usual build, so that no dependency compiles again."""
    with tempfile.TemporaryDirectory() as scratch:
        # RUSTC_BOOTSTRAP lets the stable rustdoc write JSON. Set for cargo, it would make all dependencies compile anew.
        wrapper = Path(scratch) / "rustdoc"
        wrapper.write_text(f'#!/bin/sh\nRUSTC_BOOTSTRAP=1 exec {os.environ.get("RUSTDOC", "rustdoc")} "$@"\n')
        wrapper.chmod(0o755)
        flags = "-Z unstable-options --output-format json --cap-lints allow"
        subprocess.run(
            ["cargo", "doc", "-q", "--release", "--locked", "--no-deps"],
            cwd=ROOT,
            env={**os.environ, "RUSTDOC": str(wrapper), "RUSTDOCFLAGS": flags},
            check=True,
        )


def document(package):
    target = Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
    return json.loads((target / "doc" / f"{package.replace('-', '_')}.json").read_text())


def re_exports():
    """What src/lib.rs re-exports: (feature, path of the item, its name in `foreframe`). The file is a list of names."""
    found, feature, module = [], "", "foreframe"
    text = re.sub(r"//.*", "", (ROOT / "src" / "lib.rs").read_text())
    for part in re.findall(r"#\[cfg\(feature = \"\w+\"\)\]|pub mod \w+ \{|pub use [^;]+;|\n\}", text):
        if part.startswith("#"):
            feature = part.split('"')[1]
        elif part.startswith("pub mod"):
            module = f"foreframe::{part.split()[2]}"
        elif part.startswith("pub use"):
            path, _, names = "".join(part.split())[len("pubuse") : -1].partition("{")
            if not names:
                path, names = path.rsplit("::", 1)
                path += "::"
            found += [(feature, path + name, f"{module}::{name}") for name in names.strip("}").split(",") if name]
        else:
            feature, module = "", "foreframe"
    return found


class Crate:
    """The documented items of one crate."""

    def __init__(self, document):
        self.index = document["index"]
        self.paths = document["paths"]
        # The types named in signatures, and where.
        self.used, self.reader = {}, ""

    def item(self, number):
        return self.index.get(str(number))

    def resolve(self, source):
        """The item at a path, also where modules re-export it."""
        module = next(item for item in self.index.values() if "module" in item["inner"] and item["inner"]["module"]["is_crate"])
        names = source.split("::")[1:]
        for position, name in enumerate(names):
            module = self.member(module, name)
            if module is None:
                raise SystemExit(f"public_api: {source} is not in the documentation ({'::'.join(names[:position + 1])})")
        return module

    def member(self, module, name):
        globs = []
        for item in filter(None, map(self.item, module["inner"]["module"]["items"])):
            use = item["inner"].get("use")
            if use and use["name"] == name and not use["is_glob"]:
                return self.item(use["id"])
            if not use and item["name"] == name and "macro" not in item["inner"]:
                return item
            globs += [use] if use and use["is_glob"] else []
        return next(filter(None, (self.member(self.item(use["id"]), name) for use in globs)), None)

    def text(self, kind):
        """A type as text. Notes the types that it names."""
        if kind is None:
            return "()"
        (tag, value), = kind.items() if isinstance(kind, dict) else ((kind, None),)
        if tag == "resolved_path":
            known = self.paths.get(str(value["id"]))
            if known:
                self.used["::".join(known["path"])] = self.reader
            arguments = self.arguments(value.get("args"))
            return value["path"].split("::")[-1] + (f"<{', '.join(arguments)}>" if arguments else "")
        if tag in ("primitive", "generic"):
            return value
        if tag == "borrowed_ref":
            return f"&{'mut ' if value['is_mutable'] else ''}{self.text(value['type'])}"
        if tag == "tuple":
            return f"({', '.join(map(self.text, value))})"
        if tag == "slice":
            return f"[{self.text(value)}]"
        if tag == "array":
            return f"[{self.text(value['type'])}; {value['len']}]"
        if tag == "impl_trait":
            return "impl " + " + ".join(self.bound(bound) for bound in value)
        if tag == "dyn_trait":
            return "dyn " + " + ".join(self.text({"resolved_path": bound["trait"]}) for bound in value["traits"])
        if tag == "qualified_path":
            return f"{self.text(value['self_type'])}::{value['name']}"
        if tag == "function_pointer":
            return self.signature("fn", value["sig"])
        return tag

    def bound(self, bound):
        return self.text({"resolved_path": bound["trait_bound"]["trait"]}) if "trait_bound" in bound else "'_"

    def arguments(self, arguments):
        inner = (arguments or {}).get("angle_bracketed") or (arguments or {}).get("parenthesized")
        if inner is None:
            return []
        if "args" in inner:
            return [self.text(argument["type"]) for argument in inner["args"] if "type" in argument]
        return [f"({', '.join(map(self.text, inner['inputs']))}) -> {self.text(inner['output'])}"]

    def signature(self, name, signature):
        inputs = [self.text(kind) if label != "self" else self.text(kind).replace("Self", "self") for label, kind in signature["inputs"]]
        output = f" -> {self.text(signature['output'])}" if signature["output"] else ""
        return f"{name}({', '.join(inputs)}){output}"

    def lines(self, name, item):
        """What a user sees of an item, one line each."""
        (kind, inner), = item["inner"].items()
        if kind == "function":
            return [self.signature(f"fn {name}", inner["sig"])]
        lines = [f"{kind} {name}"]
        if kind == "struct":
            fields = inner["kind"].get("plain", {}).get("fields", []) if isinstance(inner["kind"], dict) else []
            lines += [f"  {field['name']}: {self.text(field['inner']['struct_field'])}" for field in filter(None, map(self.item, fields))]
        if kind == "enum":
            for variant in filter(None, map(self.item, inner["variants"])):
                lines.append(f"  {variant['name']}{self.variant(variant['inner']['variant']['kind'])}")
        members = [self.item(number) for number in inner.get("items", [])]
        for block in filter(None, map(self.item, inner.get("impls", []))):
            if block["inner"]["impl"]["trait"] is None:
                members += [self.item(number) for number in block["inner"]["impl"]["items"]]
        methods = [self.signature(f"  fn {member['name']}", member["inner"]["function"]["sig"]) for member in members if member and "function" in member["inner"]]
        return lines + sorted(methods)

    def variant(self, kind):
        if kind == "plain":
            return ""
        numbers = kind["tuple"] if "tuple" in kind else kind["struct"]["fields"]
        fields = [self.item(number) for number in numbers if number is not None]
        texts = [self.text(field["inner"]["struct_field"]) for field in fields if field]
        if "tuple" in kind:
            return f"({', '.join(texts)})"
        return " { " + ", ".join(f"{field['name']}: {text}" for field, text in zip(filter(None, fields), texts)) + " }"


def interface():
    write_documents()
    crates = {f"foreframe_{name}": Crate(document(f"foreframe-{name}")) for name in CRATES}
    exports = re_exports()
    lines, problems, canonical = [], [], set()
    for feature, source, name in sorted(exports, key=lambda entry: entry[2]):
        crate = crates[source.split("::")[0]]
        item = crate.resolve(source)
        canonical.add("::".join(crate.paths[str(item["id"])]["path"]))
        crate.reader = name
        lines += [f"{line}{f'  (feature {feature})' if feature else ''}" if number == 0 else line for number, line in enumerate(crate.lines(name, item))]
    bare = sum(not feature for feature, _, _ in exports)
    lines.append(f"# {bare} names without features, {len(exports)} with all")
    for count, most in [(bare, MOST_BARE), (len(exports), MOST_ALL)]:
        if count > most:
            problems.append(f"{count} names; at most {most} are wanted")
    for path, reader in sorted({entry for crate in crates.values() for entry in crate.used.items()}):
        if path.startswith(FORBIDDEN):
            problems.append(f"{reader} names {path}, a type of the tensor library")
        elif path.startswith("foreframe") and path not in canonical:
            problems.append(f"{reader} names {path}, which `foreframe` does not re-export")
    return "\n".join(lines) + "\n", problems


def main():
    text, problems = interface()
    if "--update" in sys.argv[1:]:
        SNAPSHOT.write_text(text)
    elif SNAPSHOT.read_text() != text:
        changes = difflib.unified_diff(SNAPSHOT.read_text().splitlines(), text.splitlines(), "before", "now", n=0, lineterm="")
        print("\n".join(list(changes)[:60]))
        problems.append(
            "the public interface changed; if that is meant, run `python3 .ci/public_api.py --update` and name it in CHANGELOG.md"
        )
    for problem in problems:
        print(f"public_api: {problem}", file=sys.stderr)
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()
