"""Wrong benches without a gauge: does the true force stay below the rating of the sensor?"""
