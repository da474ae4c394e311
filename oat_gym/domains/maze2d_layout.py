"""The geometry of mazes of square cells, in PointMaze's coordinates."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from oat_gym.errors import ConfigurationError

Cell = tuple[int, int]
FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Maze:
    """A maze of square cells centred on the origin, in PointMaze's coordinates (metres, x right, y up).

    Args:
        cells: rows from the top; 1 is a wall, 0 is free.
        size: edge of a cell in metres.

    Raises:
        ConfigurationError: for an empty or ragged map, other cell values, or a size that is not positive.

    >>> maze = Maze(((1, 1, 1), (1, 0, 1), (1, 1, 1)))
    >>> maze.center((1, 1)).tolist(), maze.cell_of(np.array([0.4, -0.4])), len(maze.walls())
    ([0.0, 0.0], (1, 1), 8)
    """

    cells: tuple[tuple[int, ...], ...]
    size: float = 1.0

    def __post_init__(self) -> None:
        """Check the map."""
        if not self.cells or not self.cells[0] or len({len(row) for row in self.cells}) != 1:
            raise ConfigurationError(f"cells must be rows of one length, got {self.cells!r}.")
        if not {cell for row in self.cells for cell in row} <= {0, 1}:
            raise ConfigurationError(f"cells must hold 0 (free) and 1 (wall) only, got {self.cells!r}.")
        if not self.size > 0:
            raise ConfigurationError(f"size must be positive, got {self.size}.")

    @property
    def free(self) -> tuple[Cell, ...]:
        """The free cells as (row, column), row by row."""
        return tuple((i, j) for i, row in enumerate(self.cells) for j, cell in enumerate(row) if cell == 0)

    def center(self, cell: Cell) -> FloatArray:
        """Return the (x, y) of a cell's centre."""
        rows, columns = len(self.cells), len(self.cells[0])
        return self.size * np.array([cell[1] + 0.5 - columns / 2, rows / 2 - cell[0] - 0.5])

    def cell_of(self, position: FloatArray) -> Cell:
        """Return the (row, column) of the cell that holds `position` (x, y)."""
        rows, columns = len(self.cells), len(self.cells[0])
        row = np.floor(rows / 2 - position[1] / self.size)
        return int(row), int(np.floor(position[0] / self.size + columns / 2))

    def walls(self) -> FloatArray:
        """Return the wall cells as an (n, 4) array of x, y (lower left corner), width and height."""
        corners = [
            (*(self.center((i, j)) - self.size / 2), self.size, self.size)
            for i, row in enumerate(self.cells)
            for j, cell in enumerate(row)
            if cell == 1
        ]
        return np.array(corners, dtype=np.float64).reshape(-1, 4)

    def shortest_path(self, start: Cell, goal: Cell) -> list[Cell]:
        """Return the cells from `start` to `goal`, both included, by breadth-first search over free neighbours.

        Raises:
            ConfigurationError: if either is not free, or no path joins them.
        """
        free = set(self.free)
        if not {start, goal} <= free:
            raise ConfigurationError(f"start={start} and goal={goal} must be free cells; these are {self.free}.")
        before: dict[Cell, Cell] = {start: start}
        queue = deque([start])
        while queue and goal not in before:
            i, j = queue.popleft()
            for cell in ((i - 1, j), (i, j - 1), (i, j + 1), (i + 1, j)):
                if cell in free and cell not in before:
                    before[cell] = (i, j)
                    queue.append(cell)
        if goal not in before:
            raise ConfigurationError(f"No path joins start={start} and goal={goal}.")
        path = [goal]
        while path[-1] != start:
            path.append(before[path[-1]])
        return path[::-1]


UMAZE = Maze(((1, 1, 1, 1, 1), (1, 0, 0, 0, 1), (1, 1, 1, 0, 1), (1, 0, 0, 0, 1), (1, 1, 1, 1, 1)))
"""The map of `PointMaze_UMaze-v3`."""
