"""When sensors saw what: streams matched in time, clocks compared, frozen frames found, stamps judged."""
