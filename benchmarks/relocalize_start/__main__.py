"""`python -m benchmarks.relocalize_start`."""

from benchmarks.relocalize_start.benchmark import main

if __name__ == "__main__":
    main()
