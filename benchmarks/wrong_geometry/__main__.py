"""`python -m benchmarks.wrong_geometry`."""

from benchmarks.wrong_geometry.benchmark import main

if __name__ == "__main__":
    main()
