"""Draws docs/images/transport.svg from the table of lib/render/benches/transport.rs.

    cargo bench -p dipir-render --bench transport -- "$PWD/transport.csv"
    python3 -m venv venv && venv/bin/pip install matplotlib
    venv/bin/python benches/plot_transport.py transport.csv docs/images/transport.svg
"""
import csv
import sys

import matplotlib

matplotlib.use("svg")
import matplotlib.pyplot as plt

ORANGE, BLUE, GREY = "#c2571a", "#2b6cb0", "#777777"


def main(table, picture):
    with open(table) as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        row["mb"] = (float(row["object_bytes"]) + float(row["shadow_bytes"])) / 1e6
    half = [r for r in rows if r["columns"] == "128" and r["precision"] == "Half"]
    foreseen = [r for r in half if r["light_in_mixture"] == "true"]
    blind = [r for r in half if r["light_in_mixture"] == "false"]
    sizes = [r for r in rows if r["samples"] == "128" and r["light_in_mixture"] == "true"]
    plt.rcParams.update({"svg.hashsalt": "dipir", "font.size": 9, "axes.spines.top": False,
                         "axes.spines.right": False})
    figure, axes = plt.subplots(1, 3, figsize=(10.5, 3.4), layout="constrained")

    def sweep(axis, group, x, y, colour, label, dash="-", names=None):
        xs, ys = [float(r[x]) for r in group], [float(r[y]) for r in group]
        axis.plot(xs, ys, dash, marker="o", markersize=4, color=colour, label=label)
        for r, a, b in zip(group, xs, ys):
            if names:
                axis.annotate(names(r), (a, b), textcoords="offset points", xytext=(0, 7), ha="center", color=GREY)

    count = lambda r: r["samples"]
    for axis, what in ((axes[0], "object_error"), (axes[1], "region_gradient_error")):
        sweep(axis, foreseen, "record_s", what, ORANGE, "light in the mixture", names=count)
        sweep(axis, blind, "record_s", what, BLUE, "light unknown", "--")
        axis.set_xlabel("time to record, s (numbers: samples a pixel)")
        axis.legend(frameon=False)
    axes[0].set_ylabel("relative error of the object")
    axes[1].set_ylabel("relative noise of the gradient, regions")
    sizes.sort(key=lambda r: (r["precision"], int(r["columns"])))
    halves = [r for r in sizes if r["precision"] == "Half"]
    singles = [r for r in sizes if r["precision"] == "Single"]
    name = lambda r: r["columns"]
    halves.sort(key=lambda r: r["mb"])
    sweep(axes[2], halves, "mb", "object_error", ORANGE, "half precision", names=name)
    sweep(axes[2], singles, "mb", "object_error", BLUE, "single precision")
    axes[2].set_xlabel("size of the record, MB (numbers: columns of the map)")
    axes[2].set_ylabel("relative error of the object")
    axes[2].legend(frameon=False)
    axes[2].set_xlim(0, 55)
    axes[2].set_ylim(0, 0.15)
    for axis in axes[:2]:
        axis.set_xscale("log")
        axis.set_yscale("log")
    for axis in axes:
        if axis is not axes[2]:
            axis.margins(x=0.2, y=0.15)
        axis.grid(True, which="both", color="#dddddd", linewidth=0.5)
        axis.set_axisbelow(True)
    # White behind it, so that it can be read on a dark page too.
    figure.savefig(picture, metadata={"Date": None}, facecolor="white")


if __name__ == "__main__":
    main(*sys.argv[1:3])
