"""Writes positions.csv: where the sun is, computed with PyEphem, which sums the VSOP87 theory.

    pip install ephem==4.2.1 && python3 positions.py > positions.csv

Geometric positions from the place (topocentric, no refraction), azimuth clockwise from north, degrees.
"""
import math
import random

import ephem

random.seed(1)
print("time,latitude_deg,longitude_deg,azimuth_deg,elevation_deg")
for _ in range(200):
    year = random.randint(1950, 2080)
    month, day = random.randint(1, 12), random.randint(1, 28)
    hour, minute, second = random.randint(0, 23), random.randint(0, 59), random.randint(0, 59)
    place = ephem.Observer()
    latitude = round(random.uniform(-80, 80), 3)
    longitude = round(random.uniform(-180, 180), 3)
    place.lat, place.lon = str(latitude), str(longitude)
    place.elevation, place.pressure = 0, 0
    place.date = (year, month, day, hour, minute, second)
    sun = ephem.Sun(place)
    azimuth, elevation = math.degrees(sun.az), math.degrees(sun.alt)
    time = f"{year}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z"
    print(f"{time},{latitude},{longitude},{azimuth:.4f},{elevation:.4f}")
