"""`python -m benchmarks.train_cells`."""

from benchmarks.train_cells.benchmark import main

if __name__ == "__main__":
    main()
