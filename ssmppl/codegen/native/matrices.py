"""Operations on small matrices -> LLVM IR, entry by entry and without branches: so a loop over
particles vectorises, and each gives the numbers of the kernel of its name in `math/scalars.py`.

`let(text)` writes an instruction and gives the name of its value; entries are such names.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field

from ssmppl.codegen.kernels.math.scalars import PIVOT

Let = Callable[[str], str]
Rows = list[list[str]]

# The largest n: lines of a Cholesky factor grow as n^3 / 6, of an elimination as 6 n^3.
LARGEST = {"cholesky": 16, "inverse": 6, "logdet": 6, "det": 6}
NAN, MINUS_INFINITY = "0x7FF8000000000000", "0xFFF0000000000000"
ROUNDING = f"0x{struct.unpack('<Q', struct.pack('<d', PIVOT))[0]:016X}"


def cholesky(let: Let, entries: Rows) -> Rows:
    """The lower Cholesky factor of a matrix that may be singular, as the kernel of this name."""
    a, n = [list(row) for row in entries], len(entries)
    for j in range(n):
        least = let(f"fmul double {ROUNDING}, {a[j][j]}")
        for k in range(j):
            a[j][j] = _less_product(let, a[j][j], a[j][k], a[j][k])
        low = let(f"fcmp ole double {a[j][j]}, 0.0")
        high = let(f"fcmp oge double {a[j][j]}, {let(f'fneg double {least}')}")
        gone = let(f"and i1 {low}, {high}")
        for i in range(j + 1, n):
            for k in range(j):
                a[i][j] = _less_product(let, a[i][j], a[i][k], a[j][k])
            square = let(f"fmul double {a[i][j]}, {a[i][j]}")
            most = let(f"fmul double {least}, {a[i][i]}")
            gone = let(f"and i1 {gone}, {let(f'fcmp ole double {square}, {most}')}")
        positive = let(f"fcmp ogt double {a[j][j]}, 0.0")
        root = let(f"call double @llvm.sqrt.f64(double {a[j][j]})")
        root = _either(let, positive, root, NAN)
        for i in range(j + 1, n):
            a[i][j] = _either(let, gone, "0.0", let(f"fdiv double {a[i][j]}, {root}"))
        a[j][j] = _either(let, gone, "0.0", root)
    return a


def inverse(let: Let, entries: Rows) -> Rows:
    """The inverse; nan where the matrix is singular."""
    n = len(entries)
    found = _Elimination(let, entries, [["1.0" if i == j else "0.0" for j in range(n)]
                                        for i in range(n)])  # fmt: skip
    regular = let(f"fcmp oeq double {_size(let, found.sign)}, 1.0")
    return [
        [_either(let, regular, let(f"fdiv double {x}, {found.a[i][i]}"), NAN) for x in row]
        for i, row in enumerate(found.b)
    ]


def det(let: Let, entries: Rows) -> str:
    """The determinant: the product of the pivots, with the sign of their permutation."""
    found = _Elimination(let, entries, [[] for _ in entries])
    size = _product(let, _size(let, found.sign), found.a)
    size = _either(let, found.singular, found.product, size)
    return let(f"call double @llvm.copysign.f64(double {size}, double {found.sign})")


def logdet(let: Let, entries: Rows, log: Let) -> str:
    """log |det|; -inf where singular. log : of a number."""
    found = _Elimination(let, entries, [[] for _ in entries])
    total = "0.0"
    for pivot in found.pivots:
        total = let(f"fadd double {total}, {log(_size(let, pivot))}")
    return _either(let, found.singular, found.last, total)


@dataclass
class _Elimination:
    """Gauss-Jordan with partial pivoting on (a | b); what the kernel leaves where a is singular is
    chosen behind, as of the first column without a pivot.

    sign : of the permutation and the pivots; 0 or nan where singular. last : -inf or nan, the log
    of the determinant there. product : |sign| times the diagonal there.
    """

    let: Let
    entries: Rows
    b: Rows
    a: Rows = field(init=False)
    pivots: list[str] = field(default_factory=list)
    singular: str = "false"
    sign: str = "1.0"
    last: str = MINUS_INFINITY
    product: str = "0.0"

    def __post_init__(self) -> None:
        self.a, n = [list(row) for row in self.entries], len(self.entries)
        before = "0.0"  # the sign where singular
        for j in range(n):
            diagonal = [list(row) for row in self.a]
            self._swap(j)
            pivot, let = self.a[j][j], self.let
            none = let(f"fcmp ule double {_size(let, pivot)}, 0.0")  # nan too
            zero = let(f"fmul double {pivot}, 0.0")
            here = let(f"and i1 {none}, {let(f'xor i1 {self.singular}, true')}")
            before = _either(let, here, zero, before)
            gone = let(f"fadd double {pivot}, {MINUS_INFINITY}")
            self.last = _either(let, here, gone, self.last)
            product = _product(let, _size(let, zero), diagonal)
            self.product = _either(let, here, product, self.product)
            self.singular = let(f"or i1 {self.singular}, {none}")
            self._negate(let(f"fcmp olt double {pivot}, 0.0"))
            self.pivots.append(pivot)
            self._clear(j)
        self.sign = _either(self.let, self.singular, before, self.sign)

    def _swap(self, j: int) -> None:
        """Row j with the first of the rows below whose entry in column j is the largest."""
        let, a = self.let, self.a
        largest, here = _size(let, a[j][j]), dict[int, str]()
        for i in range(j + 1, len(a)):
            size = _size(let, a[i][j])
            larger = let(f"fcmp ogt double {size}, {largest}")
            largest = _either(let, larger, size, largest)
            smaller = let(f"xor i1 {larger}, true")
            here = {k: let(f"and i1 {flag}, {smaller}") for k, flag in here.items()}
            here[i] = larger
        for rows in (a, self.b):
            top = list(rows[j])
            for i, flag in here.items():
                own = rows[i]
                rows[j] = [_either(let, flag, x, y) for x, y in zip(own, rows[j], strict=True)]
                rows[i] = [_either(let, flag, x, y) for x, y in zip(top, own, strict=True)]
        for flag in here.values():
            self._negate(flag)

    def _clear(self, j: int) -> None:
        """Column j of the other rows."""
        let, a, b = self.let, self.a, self.b
        scale = let(f"fdiv double 1.0, {a[j][j]}")
        for i in range(len(a)):
            if i == j:
                continue
            wanted = let(f"fcmp une double {a[i][j]}, 0.0")
            factor = let(f"fmul double {a[i][j]}, {scale}")
            for rows, first in ((a, j), (b, 0)):
                for k in range(first, len(rows[i])):
                    less = _less_product(let, rows[i][k], factor, rows[j][k])
                    rows[i][k] = _either(let, wanted, less, rows[i][k])

    def _negate(self, where: str) -> None:
        other = self.let(f"fneg double {self.sign}")
        self.sign = _either(self.let, where, other, self.sign)


def _either(let: Let, condition: str, yes: str, no: str) -> str:
    return let(f"select i1 {condition}, double {yes}, double {no}")


def _size(let: Let, number: str) -> str:
    return let(f"call double @llvm.fabs.f64(double {number})")


def _less_product(let: Let, number: str, first: str, second: str) -> str:
    product = let(f"fmul double {first}, {second}")
    return let(f"fsub double {number}, {product}")


def _product(let: Let, first: str, rows: Rows) -> str:
    """first times the sizes of the diagonal."""
    for j, row in enumerate(rows):
        first = let(f"fmul double {first}, {_size(let, row[j])}")
    return first
