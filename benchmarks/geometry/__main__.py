"""`python -m benchmarks.geometry`."""

from benchmarks.geometry.benchmark import main

if __name__ == "__main__":
    main()
