"""`python -m benchmarks.tracking`."""

from benchmarks.tracking.benchmark import main

if __name__ == "__main__":
    main()
