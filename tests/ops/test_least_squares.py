import numpy as np
import torch

from p2gs.ops.least_squares import least_squares


def junk() -> None:
    """Leaves small blocks of memory with other numbers in them."""
    _ = [torch.randint(0, 3, (size,), dtype=torch.int32) for size in range(1, 9)]


def test_agrees_with_numpy_at_any_rank():
    generator = torch.Generator().manual_seed(0)
    for rows, columns, rank in ((6, 6, 6), (9, 4, 4), (6, 6, 3), (3, 5, 3)):
        A = (
            torch.randn(rows, rank, generator=generator).double()
            @ torch.randn(rank, columns, generator=generator).double()
        )
        b = torch.randn(rows, generator=generator).double()
        expected = torch.from_numpy(np.linalg.lstsq(A.numpy(), b.numpy(), rcond=1e-9)[0])
        torch.testing.assert_close(least_squares(A, b), expected, rtol=1e-9, atol=1e-9)


def test_the_same_input_gives_the_same_bits():
    A = torch.randn(50, 2, generator=torch.Generator().manual_seed(0)).double()
    A, b = A.T @ A, torch.ones(2).double()
    first = least_squares(A, b)
    for _ in range(300):
        junk()
        assert torch.equal(least_squares(A, b), first)
