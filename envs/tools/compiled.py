"""Optimal control problems translated to C by CasADi, and compiled."""

import contextlib
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca

COMPILER_FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")


def vectorised(source):
    """CasADi's C code with the loops of its dense matrix product in an order that compilers turn into vector instructions.

    The terms of every sum keep their order. It triples the speed of the networks' Hessians; text that is not found is left as it is.
    """
    start = source.find("void casadi_mtimes_dense(")
    head, product, rest = source[:start], source[start : start + 800], source[start + 800 :]
    for name in ("x", "y", "z"):
        product = product.replace(f"casadi_real* {name},", f"casadi_real* restrict {name},", 1)
    rows, terms = "for (j=0; j<nrow_x; ++j) {", "for (k=0; k<ncol_x; ++k) {"
    product = re.sub(f"{re.escape(rows)}(\\s+){re.escape(terms)}", rf"{terms}\1{rows}", product)
    return head + product + rest if start >= 0 else source


def compiled_solver(plugin, nlp, options):
    """`options(name) -> nlpsol options` for the names "cold" and "warm" turned into two solvers on compiled functions, or None.

    The C code of the problem and its derivatives is compiled once and kept in a cache folder under a hash of source, compiler
    and processor; it appears there by an atomic rename, so that parallel processes may race for it. Where anything of that
    fails (no compiler, no place to write, a library that does not load), a notice is printed and None returned.
    """
    compiler = next(filter(None, map(shutil.which, ("gcc", "clang", "cc"))), None)
    try:
        if compiler is None:
            raise OSError("no gcc, clang or cc")
        version = subprocess.run([compiler, "--version"], capture_output=True, check=True).stdout
        cpu = Path("/proc/cpuinfo")
        flags = re.search(r"^(flags|Features)\s*:.*", cpu.read_text(), re.MULTILINE) if cpu.exists() else None
        processor = flags[0] if flags else platform.processor()
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "rlmpc"
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):  # CasADi writes into the current folder
            ca.nlpsol("nlp", plugin, nlp, options("cold")).generate_dependencies("nlp.c")
            source = vectorised(Path("nlp.c").read_text()).encode()
            Path("nlp.c").write_bytes(source)
            key = hashlib.sha256(source + version + f"{COMPILER_FLAGS} {processor}".encode()).hexdigest()[:32]
            library = cache / f"{key}.so"
            if not library.exists():
                cache.mkdir(parents=True, exist_ok=True)
                built = cache / f"{key}.{os.getpid()}"
                subprocess.run([compiler, *COMPILER_FLAGS, "nlp.c", "-o", str(built), "-lm"], check=True, capture_output=True)
                os.replace(built, library)
        return {name: ca.nlpsol(name, plugin, str(library), options(name)) for name in ("cold", "warm")}
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        print(f"notice: running interpreted, several times slower ({error})", file=sys.stderr)
        return None
