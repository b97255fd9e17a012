"""Reading tables of trials: separators, mh1823's wide form, products without object, and one clear line for each
mistake.
"""

from pathlib import Path

import pytest

from raytwin.errors import FileFormatError, InputError
from raytwin.pod import read_pod_table
from raytwin.pod.answer import trials_from_table


def written(folder: Path, text: str) -> Path:
    path = folder / "table.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_hits_of_detect_leave_products_without_object_out_and_count_their_alarms(tmp_path):
    path = written(
        tmp_path,
        "contrast,size_mm,hit,network,image,foreign_object,setting,false_alarm\n"
        "0.1,2,1,n0,i0,bone,20ms,\n0.2,3,0,n1,i0,bone,20ms,\n,,,n0,i1,,20ms,1\n,,,n1,i1,,20ms,0\n,,,n2,i1,,20ms,\n",
    )
    table = read_pod_table(path)
    assert table.size_name == "contrast"
    assert table.size.tolist() == [0.1, 0.2]
    assert table.hits.tolist() == [1, 0]
    assert table.network == ("n0", "n1")
    assert table.false_alarm.tolist() == [1, 0]
    assert table.false_alarm_network == ("n0", "n1")
    assert table.numbers("size_mm").tolist() == [2, 3]
    assert any("no word of a false alarm" in note for note in table.notes)
    assert read_pod_table(path, size="size_mm").size.tolist() == [2, 3]


def test_without_a_false_alarm_column_a_hit_on_nothing_is_a_false_alarm(tmp_path):
    table = read_pod_table(written(tmp_path, "size,hit\n1,1\n2,0\n,1\n,0\n,0\n"))
    assert table.false_alarm.tolist() == [1, 0, 0]


def test_an_object_without_its_size_is_left_out_and_said(tmp_path):
    table = read_pod_table(written(tmp_path, "contrast,hit,foreign_object\n0.1,1,bone\n,1,bone\n0.3,0,bone\n"))
    assert len(table.size) == 2
    assert len(table.false_alarm) == 0
    assert "left out: 1 row with a foreign object but no contrast" in table.notes[0]


@pytest.mark.parametrize(
    "text",
    [
        "size,hit\n0.5,1\n1.5,0\n",
        "size;hit\n0,5;1\n1,5;0\n",
        "size\thit\n0.5\t1\n1.5\t0\n",
        "# a comment\n\nSize,Hit\n0.5, hit\n1.5, miss\n",
        "\ufeffsize,hit\r\n0.5,true\r\n1.5,no\r\n",
        '"size","detected"\n"0.5","1"\n"1.5","0"\n',
    ],
)
def test_common_spellings_read_alike(tmp_path, text):
    table = read_pod_table(written(tmp_path, text))
    assert (table.size.tolist(), table.hits.tolist()) == ([0.5, 1.5], [1, 0])


def test_mh1823_columns_of_inspections_become_looks(tmp_path):
    path = written(tmp_path, "ID,size,AL,BL,CL\nt1,0.5,1,0,1\nt2,1.5,1,1,1\nt3,0.2,0,0,0\n")
    table = read_pod_table(path)
    assert len(table.size) == 9
    assert table.hits.tolist() == [1, 0, 1, 1, 1, 1, 0, 0, 0]
    assert table.network[:3] == ("AL", "BL", "CL")
    assert table.image[:4] == ("t1", "t1", "t1", "t2")
    assert "columns AL, BL, CL read as 3 inspections" in table.notes[0]
    assert len(read_pod_table(path, hit="AL,CL").size) == 6
    assert len(read_pod_table(path, hit=["BL"]).size) == 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("size,weight\n1,0\n2,1\n", "hit: got columns size, weight; expected one of hit, hits"),
        ("size,h\n1,0\n2,1\n", "name the column: hit=... (--hit)"),
        ("size,weight,flag,angle\n1,0,1,3.5\n2,1,1,7\n", "name the column: hit=... (--hit)"),
        ("size,hti\n1,0\n2,1\n", "did you mean hti? name it: hit='hti' (--hit hti)"),
        ("size_mm,Detect\n1,0\n2,1\n", "did you mean Detect? name it: hit='Detect' (--hit Detect)"),
    ],
)
def test_a_column_of_0_and_1_under_another_name_is_no_column_of_hits(tmp_path, text, words):
    with pytest.raises(InputError) as error:
        read_pod_table(written(tmp_path, text))
    assert words in str(error.value)


def test_an_inspection_that_did_not_look_is_no_trial(tmp_path):
    table = read_pod_table(written(tmp_path, "ID,size,AL,BL\nt1,0.5,1,\nt2,1.5,1,0\n"), hit="AL,BL")
    assert table.hits.tolist() == [1, 1, 0]


def test_only_the_rows_asked_for(tmp_path):
    path = written(tmp_path, "size,hit,setting\n1,1,20ms\n2,0,20ms\n3,1,50ms\n")
    assert read_pod_table(path, where={"setting": "20ms"}).size.tolist() == [1, 2]
    with pytest.raises(InputError, match="expected one of 20ms, 50ms"):
        read_pod_table(path, where={"setting": "10ms"})


def test_responses_of_products_without_object_are_noise(tmp_path):
    table = read_pod_table(written(tmp_path, "size,p\n1,0.5\n2,0.7\n,0.1\n,\n"), response="p")
    assert table.response.tolist() == [0.5, 0.7]
    assert table.noise_response.tolist() == [0.1]
    assert table.hits is None


@pytest.mark.parametrize(
    ("text", "options", "words"),
    [
        (
            "size,hit\n1,1\n2,0\n",
            {"size": "sise"},
            "size: got 'sise'; expected a column of the table: size, hit; did you mean size?",
        ),
        ("size,hit\n1,1\n2,0\n", {"hit": "hti"}, "did you mean hit?"),
        ("size,hit\n1,1\n2,0\n", {"site": "sitee"}, "site: got 'sitee'"),
        ("weight,hit\n1,1\n2,0\n", {}, "name the column: size=... (--size)"),
        ("size,seen\n1,maybe\n2,0\n", {}, "name the column: hit=... (--hit)"),
        ("size,hit\n1,1\ninf,0\n", {}, "column size, line 3: got 'inf'; expected a finite number"),
        (
            "size;hit\n0,885;1\n0,9;1\n1.566;0\n",
            {},
            "column size: got '0,885' in line 2 and '1.566' in line 4; expected decimal commas or decimal points, not both",
        ),
        ("size,hit\n1,1\n2mm,0\n", {}, "column size, line 3: got '2mm'"),
        ("size,hit\n1,1\n2,0.5\n", {}, "column hit, line 3: got '0.5'; expected 0 (miss) or 1 (hit)"),
        ("size,hit\n1,1\n2,\n", {}, "column hit, line 3: got ''"),
        ("size,hit\n1,1\n2,0,7,8,9\n", {}, "table line 3: got 5 columns; expected 2 as in the header"),
        ("size,size\n1,1\n2,0\n", {}, "expected distinct, non-empty column names"),
        ("1,1\n2,0\n", {}, "expected column names in the first line"),
        ("size,hit\n", {}, "expected a header and rows of trials"),
        ("", {}, "expected a header and rows of trials"),
        ("size,hit\n,1\n,0\n", {}, "size: got no row with a size"),
        ("size,A,B,n\n1,1,0,2\n", {"hit": "A,B", "trials": "n"}, "expected one column of hits"),
    ],
)
def test_each_mistake_in_a_table_is_one_clear_line(tmp_path, text, options, words):
    with pytest.raises(InputError) as error:
        read_pod_table(written(tmp_path, text), **options)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_are_no_tables_are_said_to_be_none(tmp_path):
    with pytest.raises(FileFormatError, match="expected a file that exists"):
        read_pod_table(tmp_path / "none.csv")
    with pytest.raises(FileFormatError, match="expected a readable text file"):
        read_pod_table(tmp_path)
    binary = tmp_path / "binary.csv"
    binary.write_bytes(bytes(range(256)))
    with pytest.raises(FileFormatError, match="got a file that is not text; expected text in UTF-8"):
        read_pod_table(binary)


def test_a_row_is_called_by_its_line_in_a_file_and_by_its_number_in_memory(tmp_path):
    columns = {"size": [1, 2, -3], "hit": [0, 1, 1], "note": ["1", "2", "x"]}
    path = written(tmp_path, "# sizes\nsize,hit,note\n1,0,1\n2,1,2\n-3,1,x\n")
    for source, place in ((path, "line 5"), (columns, "row 3")):
        table = read_pod_table(source)
        with pytest.raises(InputError, match=f"size: got -3 in {place}"):
            trials_from_table(table, log_size=True)
        with pytest.raises(InputError, match=f"column note, {place}: got 'x'"):
            table.numbers("note")
        with pytest.raises(InputError, match=f"column note, {place}: got 'x'"):
            read_pod_table(source, size="note")


@pytest.mark.parametrize(
    ("encoding", "received"),
    [("latin-1", "another encoding than UTF-8 (line 3, byte 0xfc)"), ("utf-16", "text in UTF-16")],
)
def test_another_encoding_is_named_with_what_to_save_as(tmp_path, encoding, received):
    path = tmp_path / "table.csv"
    path.write_text("size,hit,who\n1,1,Anna\n2,0,Jürgen\n", encoding=encoding)
    with pytest.raises(FileFormatError) as error:
        read_pod_table(path)
    assert f"{path}: got text in" in str(error.value) and received in str(error.value)
    assert str(error.value).endswith("save it as CSV UTF-8")


@pytest.mark.parametrize("missing", ["", "NaN", "nan", "NA", "<NA>"])
def test_a_missing_size_is_no_object_however_it_is_written(tmp_path, missing):
    table = read_pod_table(written(tmp_path, f"size,hit\n1,1\n2,0\n{missing},1\n"))
    assert (table.size.tolist(), table.false_alarm.tolist()) == ([1.0, 2.0], [1.0])


def test_a_data_frame_without_rows_is_an_empty_table():
    with pytest.raises(InputError, match="got an empty table; expected a row for each trial"):
        read_pod_table({"size": [], "hit": []})


def test_a_column_asked_for_as_numbers_must_hold_numbers(tmp_path):
    table = read_pod_table(written(tmp_path, "size,hit,colour\n1,1,red\n2,0,blue\n"))
    with pytest.raises(InputError, match="column colour, line 2: got 'red'"):
        table.numbers("colour")
    with pytest.raises(InputError, match="column: got 'thickness'"):
        table.numbers("thickness")


@pytest.mark.parametrize(
    "text",
    [
        "sep=;\nsize_mm;hit\n1,5;0\n2,5;1\n",
        "size_mm;hit;\n1,5;0;\n2,5;1;\n",
        "size_mm;hit;;\n1,5;0;;\n2,5;1;;\n",
    ],
)
def test_what_excel_adds_to_a_sheet_is_no_column(tmp_path, text):
    path = tmp_path / "sheet.csv"
    path.write_text(text, encoding="utf-8")
    table = read_pod_table(path)
    assert table.size.tolist() == [1.5, 2.5]
    assert table.hits.tolist() == [0, 1]


def test_a_column_without_a_name_that_holds_something_is_refused(tmp_path):
    path = tmp_path / "sheet.csv"
    path.write_text("size_mm;hit;\n1,5;0;\n2,5;1;7\n", encoding="utf-8")
    with pytest.raises(InputError, match="non-empty column names"):
        read_pod_table(path)


def test_rows_may_be_chosen_by_numbers_and_by_columns_only():
    table = {"size": [1, 2, 3], "hit": [0, 1, 1], "setting": [20, 20, 30]}
    assert read_pod_table(table, where={"setting": 20}).size.tolist() == [1, 2]
    with pytest.raises(InputError, match="where: got"):
        read_pod_table(table, where="setting=20")


def test_rows_of_size_0_are_told_to_be_objects():
    table = read_pod_table({"size_mm": [0, 0, 1, 2], "hit": [0, 1, 0, 1]})
    assert any("size_mm 0 taken as foreign objects" in note for note in table.notes)
