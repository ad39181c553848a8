"""C code, written by hand or translated from CasADi, compiled and kept."""

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
import numpy as np

FLAGS = ("-O3", "-march=native", "-fPIC")
WHEEL = Path(ca.__file__).parent  # CasADi's libraries, HPIPM among them, and their headers
C_SOURCES = Path(__file__).parent / "c"  # written by hand


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


def find_compiler():
    """Path of the C compiler. Raises OSError where there is none."""
    compiler = next(filter(None, map(shutil.which, ("gcc", "clang", "cc"))), None)
    if compiler is None:
        raise OSError("no gcc, clang or cc")
    return compiler


def compiled(source, *flags, link=("-lm",)):
    """Path of the shared library made of C code.

    It is kept in a cache folder under a hash of source, flags, compiler and processor, and appears there by an atomic rename, so that
    parallel processes may race for it. Raises OSError (no compiler, no place to write) or subprocess.CalledProcessError.
    """
    compiler = find_compiler()
    version = subprocess.run([compiler, "--version"], capture_output=True, check=True).stdout
    info = Path("/proc/cpuinfo")
    found = re.search(r"^(flags|Features)\s*:.*", info.read_text() if info.exists() else "", re.MULTILINE)
    processor = found[0] if found else platform.processor()
    key = hashlib.sha256(
        source.encode() + version + f"{FLAGS} {flags} {link} {processor}".encode()
    ).hexdigest()[:32]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "rlmpc"
    library = cache / f"{key}.so"
    if not _whole(library):
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            folder = Path(folder)

            def run(*command):
                subprocess.run([compiler, *command], check=True, capture_output=True, cwd=folder)

            (folder / "source.c").write_text(source, encoding="utf-8")
            run(*FLAGS, *flags, "-c", "source.c")
            # linked apart: fast-math, linked in, would change the whole process
            run("-shared", "source.o", "-o", "library.so", *link)
            built = (folder / "library.so").read_bytes()
            (folder / "library.so").write_bytes(built + hashlib.sha256(built).digest())
            os.replace(folder / "library.so", library)
    return library


def _whole(library):
    """Whether the file is there and ends with its checksum, which loaders ignore: half a library kills the process that loads it."""
    if not library.exists():
        return False
    content = library.read_bytes()
    return hashlib.sha256(content[:-32]).digest() == content[-32:]


def _notice(error):
    print(f"notice: running interpreted, several times slower ({error})", file=sys.stderr)


def compiled_solver(plugin, nlp, options):
    """`options(name) -> nlpsol options` for the names "cold" and "warm" turned into two solvers on compiled functions, or None.

    Where the problem cannot be compiled, a notice is printed and None returned.
    """
    try:
        with (
            tempfile.TemporaryDirectory() as folder,
            contextlib.chdir(folder),
        ):  # CasADi writes into the current folder
            ca.nlpsol("nlp", plugin, nlp, options("cold")).generate_dependencies("nlp.c")
            library = compiled(vectorised(Path("nlp.c").read_text()))
        return {name: ca.nlpsol(name, plugin, str(library), options(name)) for name in ("cold", "warm")}
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        _notice(error)
        return None


def generated(functions, name="functions.c"):
    """C code of CasADi functions; the name of the file begins that of what they share."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        code = ca.CodeGenerator(name)
        for function in functions:
            code.add(function)
        code.generate()
        return vectorised(Path(name).read_text())


def compiled_functions(functions):
    """CasADi functions as compiled ones, in order, or as they are where they cannot be compiled, with a notice.

    -ffast-math makes them twice as fast: whether a result is finite must be asked outside.
    """
    try:
        library = compiled(generated(functions), "-ffast-math")
        return [ca.external(function.name(), str(library)) for function in functions]
    except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
        _notice(error)
        return functions


class OnArrays:
    """A CasADi function on numpy arrays, a few microseconds a call: `f(*arrays) -> list of arrays`.

    An argument or result that is (n, columns) in CasADi is an array (columns, n): a row per node. The next call overwrites the results.
    """

    def __init__(self, function):
        self.arguments = [np.zeros(function.size_in(i)[::-1]) for i in range(function.n_in())]
        self.results = [np.zeros(function.size_out(i)[::-1]) for i in range(function.n_out())]
        self.buffer, self.evaluate = function.buffer()
        for i, value in enumerate(self.arguments):
            self.buffer.set_arg(i, memoryview(value.reshape(-1)))
        for i, value in enumerate(self.results):
            self.buffer.set_res(i, memoryview(value.reshape(-1)))

    def __call__(self, *arguments):
        for kept, value in zip(self.arguments, arguments, strict=True):
            kept[...] = value
        self.evaluate()
        return self.results
