"""`python -m benchmarks.ekf_variants`."""

from benchmarks.ekf_variants.benchmark import main

if __name__ == "__main__":
    main()
