"""`python -m benchmarks.fleet`."""

from benchmarks.fleet.benchmark import main

if __name__ == "__main__":
    main()
