"""`python -m benchmarks.train_descriptor`."""

from benchmarks.train_descriptor.benchmark import main

if __name__ == "__main__":
    main()
