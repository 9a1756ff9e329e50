"""`python -m benchmarks.flood`."""

from benchmarks.flood.benchmark import main

if __name__ == "__main__":
    main()
