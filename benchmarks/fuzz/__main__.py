"""`python -m benchmarks.fuzz`."""

from benchmarks.fuzz.benchmark import main

if __name__ == "__main__":
    main()
