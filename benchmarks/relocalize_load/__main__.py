"""`python -m benchmarks.relocalize_load`."""

from benchmarks.relocalize_load.benchmark import main

if __name__ == "__main__":
    main()
