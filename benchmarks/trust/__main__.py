"""`python -m benchmarks.trust`."""

from benchmarks.trust.benchmark import main

if __name__ == "__main__":
    main()
