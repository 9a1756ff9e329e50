"""`python -m benchmarks.merge`."""

from benchmarks.merge.benchmark import main

if __name__ == "__main__":
    main()
