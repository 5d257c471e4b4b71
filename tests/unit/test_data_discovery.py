"""What names of files, headers and first lines of strangers' recordings are taken for."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from kros.core.errors import DataError
from kros.data.discovery.dialect import look_at
from kros.data.discovery.discover import Wanted, discover
from kros.data.discovery.filenames import infer_names
from kros.data.measures import identifier, kind_of, split_header

UNITS, EPISODES = range(1, 4), range(1, 4)


def names(template: str, **other: object) -> list[str]:
    """Paths of three units and episodes, in conditions where the template has one."""
    conditions = ("load", "noload") if "{c" in template else ("",)
    return [
        template.format(u=u, c=c, e=e, letter="ABC"[u - 1], **other)
        for u in UNITS
        for c in conditions
        for e in EPISODES
    ]


def labelled(template: str) -> list[str]:
    """Paths with conditions that no list of words holds."""
    return [path.replace("noload", "light").replace("load", "heavy") for path in names(template)]


def grouped(template: str, good: str, bad: str) -> list[str]:
    """Paths of which the third unit is in another group."""
    return [path.format(g=bad if u == 3 else good) for u in UNITS for path in names(template.replace("{u}", str(u)))]


def test_conditions_groups_and_single_machines():
    dates = [f"rig_{u}.0__20220815_trajectory_0{e}.csv" for u in "AB" for e in EPISODES]
    dates += [f"rig_C.0__20230629-14333{e}_trajectory.csv" for e in EPISODES]  # in another order of words
    stamps, _ = infer_names(dates)
    first, last = (re.search(stamps, name).groupdict() for name in dates[::8])
    assert first == {"unit": "A.0", "episode": "20220815_trajectory_01"}
    assert last == {"unit": "C.0", "episode": "20230629-143333_trajectory"}
    seals = ["K_N_1bar.csv", "K_N_3bar.csv", "NAP310_1bar.csv", "NAP310_3bar.csv", "rig__O-ring257_1bar.csv"]
    found = [re.search(infer_names(seals)[0], name).groupdict() for name in seals]
    assert [f"{m['unit']}_{m['condition']}.csv" for m in found] == seals
    days, _ = infer_names([f"pump{u}/day{d}/run{e}.csv" for u in UNITS for d in (1, 2) for e in EPISODES])
    assert re.search(days, "pump2/day1/run3.csv").groupdict() == {"unit": "pump2", "episode": "day1/run3"}
    single, _ = infer_names([f"qube_20240101T12{e}{e}00_43{e}_7{e}.csv" for e in EPISODES])
    assert "(?P<unit>" not in single
    assert infer_names(["only.csv"])[0] == r"^only\.csv$"


HALLS = [f"hall{h}/crane0{u}/run{e}.csv" for h in (1, 2) for u in UNITS for e in EPISODES]


@pytest.mark.parametrize(
    ("paths", "first", "units", "ambiguous"),
    [
        (names("unit_{u:02d}/{c}/run{e}.csv"), (None, "01", "load", "run1"), 3, False),
        (names("drive{u}_{c}_trial_{e:03d}.csv.gz"), (None, "drive1", "load", "001"), 3, False),
        (names("Antrieb {u} Leerlauf Messung {e}.CSV"), (None, "1", None, "1"), 3, False),
        (names("SN1004{u}-{e}.txt"), (None, "SN10041", None, "1"), 3, False),
        (names("{letter}/2024-05-0{e}_10bar.csv"), (None, "A", None, "01"), 3, False),
        (names("design_{letter}.0__2022081{e}_run_0{e}.csv"), (None, "A.0", None, "20220811_run_01"), 3, False),
        (names("2024010{u}T120000_00{u}_{c}/x_{e:03d}.csv"), (None, "001", "load", "001"), 3, False),
        ([f"rig{u}_{p}bar.csv" for u in UNITS for p in (3, 5)], (None, "rig1", "3bar", None), 3, False),
        (HALLS, (None, "hall1/crane01", None, "run1"), 6, False),
        (grouped("{{g}}/m{u}_{e}.csv", "good", "outliers"), ("good", "m1", None, "1"), 3, False),
        (grouped("{{g}}/act{u}_run{e}.csv", "good", "faulty"), ("good", "act1", None, "run1"), 3, False),
        (grouped("{{g}}/{u}_{e}.csv", "berlin", "paris"), ("berlin", "1", None, "1"), 3, False),
        (grouped("{{g}}/SN7{u}_{c}.csv", "ok", "nok"), ("ok", "SN71", "load", None), 3, False),
        ([f"motor00_{e:02d}.csv" for e in range(3)], (None, "motor00", None, "00"), 1, False),
        ([f"bench3/pump7_{e}.csv.gz" for e in range(5)], (None, "pump7", None, "0"), 1, False),
        (names("2024-05-1{e}_motor{u}_{c}.csv"), (None, "motor1", "load", "11"), 3, False),
        (names("2024-05-1{e}/SN100{u}.CSV"), (None, "SN1001", None, "11"), 3, False),
        (names("motor{u}/{c}/2024-05-1{e}.csv"), (None, "motor1", "load", "11"), 3, False),
        (names("box{u}/box{u}_{e}.csv"), (None, "box1", None, "1"), 3, False),
        (names("run{e}_{c}_drive{u}.csv"), (None, "drive1", "load", "run1"), 3, False),
        (names("{c}/{u}/{e}.csv"), (None, "1", "load", "1"), 3, False),
        (labelled("conv{u}_{c}_run{e}.csv"), (None, "conv1", "heavy", "run1"), 3, False),
        (labelled("{c}_KX{u}_{e}.csv"), (None, "KX1", "heavy", "1"), 3, False),
        (labelled("run{e}_conv{u}_{c}.csv"), (None, "conv1", "heavy", "run1"), 3, False),
        ([f"conv{u}_{c}.csv" for u in UNITS for c in ("sine", "chirp")], (None, "conv1", None, "sine"), 3, False),
        (["x1_load.csv", "x2_noload.csv"], (None, "x1", "load", None), 2, True),
        (names("M{u} {c} {e}.Csv"), (None, "M1", "load", "1"), 3, False),
        (names("data/exp/v2/unit-{u}/rec {e}.tsv"), (None, "1", None, "1"), 3, False),
        (names("rig1_motor{u}_run{e}.csv"), (None, "motor1", None, "run1"), 3, False),
        ([f"trial{e}.csv" for e in EPISODES], (None, None, None, "trial1"), 1, False),
        ([f"pump{u}.csv" for u in UNITS], (None, "pump1", None, None), 3, False),
        (["KX1041.csv", "KX1055.csv", "KX1102.csv"], (None, "KX1041", None, None), 3, False),
        ([f"KX{u}.csv" for u in UNITS], (None, "KX1", None, None), 3, True),
        ([f"x_{e:02d}.csv" for e in range(4)], (None, "00", None, None), 4, True),
        (names("x_{c}_{e}.csv"), (None, "1", "load", None), 3, True),
    ],
)
def test_hostile_layouts_are_read_as_people_do_or_asked_about(paths, first, units, ambiguous):
    pattern, other = infer_names(sorted(set(paths), key=paths.index))
    groups = [re.search(pattern, p).groupdict() for p in paths]
    assert len({tuple(found.items()) for found in groups}) == len(set(paths))
    assert tuple(groups[0].get(g) for g in ("group", "unit", "condition", "episode")) == first
    assert len({g.get("unit") for g in groups}) == units
    assert (other is not None) == ambiguous
    assert other is None or len({re.search(other, p)["episode"] for p in paths}) == units


@pytest.mark.parametrize(
    ("header", "name", "unit"),
    [
        ("Position [mm]", "Position", "mm"),
        ("Drehzahl (1/min)", "Drehzahl", "1/min"),
        ("i/A", "i", "A"),
        ("Weg in mm", "Weg", "mm"),
        ("time_ms", "time", "ms"),
        ("speed_deg/s", "speed", "deg/s"),
        ("v_m/s", "v", "m/s"),
        ("rate_deg_s", "rate", "deg/s"),
        ("speed_km_h", "speed", "km/h"),
        ("a_m_per_s2", "a", "m/s2"),
        ("n_1_min", "n", "1/min"),
        ("current_A", "current", "A"),
        ("voltage_V", "voltage", "V"),
        ("temp_C", "temp", "C"),
        ("speed_mps", "speed", "mps"),
        ("elapsed_s", "elapsed", "s"),
        ("time_min", "time", "min"),
        ("angle_min", "angle_min", ""),
        ("i_s", "i_s", ""),
        ("theta_m", "theta_m", ""),
        ("pos_x", "pos_x", ""),
        ("v_A", "v_A", ""),
        ("tau_max", "tau_max", ""),
        ("t_h", "t", "h"),
        ("Zeit_min", "Zeit", "min"),
        ("x_min", "x_min", ""),
    ],
)
def test_units_of_measure_in_headers(header, name, unit):
    assert split_header(header) == (name, unit)


def test_names_of_channels_may_stand_in_formulas():
    assert identifier("Öldruck 2") == "oeldruck_2"
    assert identifier("2nd axis [°]") == "c2nd_axis"
    assert identifier("q", ["q"]) == "q_2"
    kinds = {"motor_speed": "velocity", "IstDrehzahl": "velocity", "tau_meas1": "torque", "pos_filt": "position"}
    assert {name: kind_of(name) for name in (*kinds, "foo")} == kinds | {"foo": ""}
    assert kind_of("x", "bar") == "pressure"


def test_lines_before_the_numbers(tmp_path: Path):
    path = tmp_path / "a.csv"
    path.write_text("; Bench 4\n# rate 1000 Hz\ntime;speed\n[s];[rpm]\nfloat;float\n0,001;1,5\n0,002;2,5\n0,003;2,5\n")
    head = look_at(path)
    assert head.fields == ("time", "speed")
    assert head.units == ("s", "rpm")
    assert (head.dialect.delimiter, head.dialect.decimal) == (";", ",")
    assert (head.dialect.skip_rows, head.dialect.unit_rows) == (2, 2)
    path.write_text("1;2\n3;4\n5;6\n")
    assert not look_at(path).dialect.header
    path.write_text("1,2\nfoo\n3,4\nfoo\n")  # no two rows of numbers side by side
    assert (look_at(path).fields, look_at(path).dialect.header) == (("1", "2"), False)
    path.write_text("once upon a time\nthere was; a table\n")
    with pytest.raises(DataError, match=r"a\.csv: no rows of numbers were found in its first 2 lines"):
        look_at(path)


def recordings(rows: int = 120, episodes: Sequence[int] = (1, 2, 3)) -> dict[str, list[str]]:
    """Lines of files of two units with a row of units of measure, which `written` writes."""
    rng, files = np.random.default_rng(0), dict[str, list[str]]()
    for name in (f"motor{u}/run{e}.csv" for u in (1, 2) for e in episodes):
        table = np.column_stack([0.01 * np.arange(rows), rng.normal(size=(rows, 3))])
        files[name] = ["time,angle,speed,voltage", "s,rad,rad/s,V", *(",".join(map(str, r)) for r in table.tolist())]
    return files


def written(folder: Path, files: dict[str, list[str]]) -> Path:
    for name, lines in files.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_text("\n".join(lines))
    return folder


def timed(lines: list[str], time: Callable[[int], float]) -> None:
    """Give samples other times."""
    lines[2:] = [f"{time(k):.6g},{line.partition(',')[2]}" for k, line in enumerate(lines[2:])]


@pytest.mark.parametrize("place", [0, 3])
@pytest.mark.parametrize(
    ("row", "reason"), [("0.48,1.0", ""), ("0.48,1.0,1e9,1.0", r"channel 'speed' is .* at sample 48,")]
)
def test_damage_costs_one_file_wherever_it_is(tmp_path: Path, place: int, row: str, reason: str):
    files = recordings()
    name = list(files)[place]
    files[name][50] = row
    found = discover(written(tmp_path, files))
    assert len(found.population.episodes) == 5
    assert [text.partition(": ")[0] for text in found.findings] == [f"left out, {name}"]
    assert re.search(reason, found.findings[0])


@pytest.mark.parametrize("place", [0, 3])
def test_time_in_other_units_is_converted_where_a_file_says_so_and_refused_elsewhere(tmp_path: Path, place: int):
    files = recordings()
    name = list(files)[place]
    milliseconds = [f"{1e3 * float(t)},{rest}" for t, _, rest in (line.partition(",") for line in files[name][2:])]
    files[name][2:] = milliseconds
    found = discover(written(tmp_path, files))
    assert len(found.population.episodes) == 5
    assert f"left out, {name}: its sampling period is 10 s, that of most is 0.01 s" in found.findings[0]
    files[name][1] = "ms,rad,rad/s,V"
    found = discover(written(tmp_path, files))
    assert (len(found.population.episodes), found.findings, found.prepare) == (6, (), ())
    assert found.population.sample_period_s == 0.01


def test_columns_are_found_by_name_in_files_that_have_more_of_them(tmp_path: Path):
    """One file has a reference before a channel that rests everywhere, which is left out all the same."""
    files = recordings()
    for name, lines in files.items():
        extra = ["target,torque", "rad,N m", *(f"{k % 7},0" for k in range(len(lines) - 2))]
        first = 0 if name.endswith("motor2/run1.csv") else 1
        lines[:] = [f"{line},{','.join(more.split(',')[first:])}" for line, more in zip(lines, extra, strict=True)]
    found = discover(written(tmp_path, files))
    assert [c.name for c in found.population.columns] == ["angle", "speed", "voltage"]
    assert len(found.population.episodes) == 6


def test_episodes_that_are_too_short_are_left_out_before_anything_is_computed(tmp_path: Path):
    files = recordings()
    del files["motor1/run1.csv"][62:]
    found = discover(written(tmp_path, files), fewest=65)
    assert found.findings == ("left out, motor1/run1.csv: it has 60 samples that can be used, and kros run needs 65",)
    with pytest.raises(DataError, match=r"none of 6 episodes can be used; it has .* kros run needs 200"):
        discover(tmp_path, fewest=200)


def test_an_episode_counts_up_to_a_gap_that_cannot_be_bridged(tmp_path: Path):
    files = recordings(300)
    files["motor2/run2.csv"][62:262] = [f"{line.partition(',')[0]},,," for line in files["motor2/run2.csv"][62:262]]
    found = discover(written(tmp_path, files), fewest=65)
    assert found.findings == ("left out, motor2/run2.csv: it has 60 samples that can be used, and kros run needs 65",)


def test_files_of_which_few_samples_are_used_are_named(tmp_path: Path):
    files = recordings(800)
    rows = files["motor2/run2.csv"]
    rows[302:402] = [f"{line.partition(',')[0]},,," for line in rows[302:402]]
    del files["motor1/run1.csv"][92:]
    found = discover(written(tmp_path, files), fewest=65)
    assert found.findings[:2] == (
        "motor2/run2.csv: 400 samples are used, of 700, the rest is behind a gap",
        "motor1/run1.csv: 90 samples are used, most have 800",
    )


def test_single_recordings_are_cut_into_as_many_episodes_as_they_hold(tmp_path: Path):
    files, names = recordings(900, [1]), Wanted(files=r"motor(?P<unit>\d)")
    assert discover(written(tmp_path, files), names, fewest=65).mapping["pieces"] == 4
    files = recordings(130, [1])
    assert discover(written(tmp_path, files), names, fewest=65).mapping["pieces"] == 2
    files = recordings(129, [1])
    with pytest.raises(DataError, match="every unit has one episode that can be used, and two are needed, of 65"):
        discover(written(tmp_path, files), names, fewest=65)


@pytest.mark.parametrize("bad", range(3))
def test_one_clock_that_runs_back_hides_time_in_no_other_file(tmp_path: Path, bad: int):
    files = recordings()
    name = list(files)[bad]
    timed(files[name], lambda k: 0.01 * k - (0.3 if k >= 40 else 0.0))
    found = discover(written(tmp_path, files))
    assert (len(found.population.episodes), found.mapping["time"]) == (5, "time")
    assert [text.partition(":")[0] for text in found.findings] == [f"left out, {name}"]


@pytest.mark.parametrize("stamp", ["2026-03-04T07:12:0{}Z", "2026-03-04T07:12:0{}+01:00", "04.03.2026 07:12:0{}"])
def test_stamps_with_and_without_a_zone_are_time(tmp_path: Path, stamp: str):
    (tmp_path / "a.csv").write_text("\n".join(["time,pos,u", *(f"{stamp.format(k)},{k}.5,1" for k in range(9))]))
    assert look_at(tmp_path / "a.csv").timestamp(0) == ("dmy" if stamp[2] == "." else "ymd")


def test_rows_that_repeat_are_dropped_and_stamps_that_repeat_need_a_period(tmp_path: Path):
    """Every tenth row twice; then stamps of which one in two hundred is that of the sample before."""
    doubled = {
        name: [line for k, line in enumerate(lines) for _ in range(1 + (k % 10 == 7))]
        for name, lines in recordings().items()
    }
    found = discover(written(tmp_path / "doubled", doubled))
    assert (found.mapping["time"], found.prepare, found.findings) == ("time", (), ())
    assert {len(found.population.read(key)) for key in found.population.episodes} == {120}
    rounded = recordings(600)
    for lines in rounded.values():
        for k in (200, 400):
            lines[k] = ",".join([lines[k - 1].partition(",")[0], lines[k].partition(",")[2]])
    with pytest.raises(DataError, match=r"found 1\.97 s .* and 1\.97 s .*if stamps are rounded, .*--period 0\.01 or"):
        discover(written(tmp_path / "rounded", rounded))
    found = discover(tmp_path / "rounded", Wanted(period_s=0.01, measured=("angle",)))
    assert len(found.population.episodes) == 6


def test_the_rate_is_found_from_times_that_are_rounded(tmp_path: Path):
    files = recordings(240)
    for lines in files.values():
        timed(lines, lambda k: round(k / 60, 2))
    found = discover(written(tmp_path, files))
    assert any("resampled to a period of 0.0167 s" in text for text in found.findings)  # not 0.02 s


LEFT_OUT = ["left out: voltage; name an --input or --measured"]


@pytest.mark.parametrize(
    ("header", "wanted", "findings"),
    [
        ("t [s],angle,speed,voltage,throttle", Wanted(), ["left out: throttle; name an --input or --measured"]),
        ("t,angle,speed,voltage,current", Wanted(), ["a step of 5 looks like ms: correct it if it is not"]),
        ("t [s],angle,speed,voltage,throttle", Wanted(inputs=("throttle",)), LEFT_OUT),
        ("t [s],angle,flow,voltage,throttle", Wanted(inputs=("flow",)), LEFT_OUT),
    ],
)
def test_what_is_guessed_or_not_recognised_is_reported(
    tmp_path: Path, header: str, wanted: Wanted, findings: list[str]
) -> None:
    """A time without a unit in steps of five, and a column whose name says nothing."""
    for name, lines in recordings().items():
        rows = [f"{5 * k},{line.partition(',')[2]},{k % 9}" for k, line in enumerate(lines[2:])]
        written(tmp_path, {name: [header, *rows]})
    found = discover(tmp_path, wanted).findings
    assert [text.endswith(end) for text, end in zip(found, findings, strict=True)] == [True] * len(findings)


def test_the_period_is_that_of_the_rows_that_are_there(tmp_path: Path):
    rng = np.random.default_rng(0)
    for unit in "ab":
        k = np.flatnonzero(rng.random(1000) > 0.03)
        rows = [f"{i * 0.02:.2f},{np.sin(i / 20):.6f},{np.cos(i / 20):.6f},{np.sin(i / 9):.6f}" for i in k]
        (tmp_path / f"{unit}_1.csv").write_text("\n".join(["time,angle,speed,u", *rows]) + "\n", encoding="utf-8")
    found = discover(tmp_path, Wanted(measured=("angle",), inputs=("u",)))
    assert any("resampled to a period of 0.02 s;" in text for text in found.findings)
