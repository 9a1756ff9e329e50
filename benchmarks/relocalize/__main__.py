"""`python -m benchmarks.relocalize`."""

from benchmarks.relocalize.benchmark import main

if __name__ == "__main__":
    main()
