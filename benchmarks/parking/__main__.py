"""`python -m benchmarks.parking`."""

from benchmarks.parking.benchmark import main

if __name__ == "__main__":
    main()
