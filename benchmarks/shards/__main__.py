"""`python -m benchmarks.shards`."""

from benchmarks.shards.benchmark import main

if __name__ == "__main__":
    main()
