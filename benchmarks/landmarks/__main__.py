"""`python -m benchmarks.landmarks`."""

from benchmarks.landmarks.benchmark import main

if __name__ == "__main__":
    main()
