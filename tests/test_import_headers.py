"""Images whose headers say how they were taken: DICOM, EDF, HIS, Nikon scans, OME-TIFF; written here to the published layouts."""

import struct

import numpy as np
import pytest
import tifffile

from raytwin.acquisition import Filter, open_acquisition
from raytwin.acquisition._image_files import iter_images, read_image
from raytwin.acquisition.image_header import read_image_header
from raytwin.acquisition.import_any import layout_of
from raytwin.errors import FileFormatError

SHAPE = (12, 17)


def picture(seed=0, *, shape=SHAPE, dtype=np.uint16):
    return np.random.default_rng(seed).integers(0, 4000, shape).astype(dtype)


# DICOM and DICONDE

TAGS = {
    "KVP": "40",
    "XRayTubeCurrentInuA": "1000",
    "ExposureTimeInuS": "20000",
    "FilterMaterial": ["COPPER", "ALUMINUM"],
    "FilterThicknessMinimum": ["0.04", "1"],
    "FilterThicknessMaximum": ["0.06", "1"],
    "DistanceSourceToDetector": "1059",
    "DistanceSourceToPatient": "990",
    "DetectorElementSpacing": ["0.15", "0.15"],
    "AnodeTargetMaterial": "TUNGSTEN",
    "FocalSpots": ["0.4"],
}


def write_dicom(path, frames, *, number=1, series="1.2.3", compressed=False, **tags):
    """A DX image (PS3.3 A.26) of unsigned 14-bit numbers in 16 bits, one frame or several."""
    pydicom = pytest.importorskip("pydicom", reason="DICOM files need the extra `dicom`")
    from pydicom.uid import DigitalXRayImageStorageForProcessing, ExplicitVRLittleEndian, RLELossless, generate_uid

    frames = np.asarray(frames)
    data = pydicom.Dataset()
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    data.file_meta.MediaStorageSOPClassUID = data.SOPClassUID = DigitalXRayImageStorageForProcessing
    data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID = generate_uid()
    data.SeriesInstanceUID, data.InstanceNumber, data.PatientName = series, number, "Component^Secret"
    data.PixelIntensityRelationship = "LIN"
    data.PixelIntensityRelationshipSign = 1
    for name, value in tags.items():
        setattr(data, name, value)
    data.Rows, data.Columns = frames.shape[-2:]
    data.SamplesPerPixel, data.PixelRepresentation = 1, 0
    data.BitsAllocated, data.BitsStored, data.HighBit = 16, 14, 13
    data.PhotometricInterpretation = tags.get("PhotometricInterpretation", "MONOCHROME2")
    if frames.ndim == 3:
        data.NumberOfFrames = len(frames)
    data.PixelData = frames.astype("<u2").tobytes()
    if compressed:
        data.compress(RLELossless)
    path.parent.mkdir(parents=True, exist_ok=True)
    data.save_as(path, enforce_file_format=True)
    return path


@pytest.fixture
def radiographs(tmp_path):
    root = tmp_path / "radiographs"
    for number in (1, 2, 10):
        time = f"1200{number:02d}.25"
        at = {"AcquisitionDate": "20240229", "AcquisitionTime": time}
        write_dicom(root / "dark" / f"d{number}.dcm", picture(number), number=number, **{**TAGS, "KVP": "0"}, **at)
        at["AcquisitionTime"] = f"1201{number:02d}.25"
        write_dicom(
            root / "b" / f"IM{number:04d}",
            picture(20 + number),
            number=number,
            SeriesDescription="Flat field",
            **TAGS,
            **at,
        )
    high = {**TAGS, "KVP": "90", "XRayTubeCurrentInuA": "500"}
    write_dicom(root / "b" / "IM0011", picture(31), number=11, SeriesDescription="Flat field", **high)
    write_dicom(
        root / "castings" / "part.dcm",
        np.stack([picture(41), picture(42)]),
        series="1.2.4",
        compressed=True,
        FrameTime="25",
        **TAGS,
    )
    (root / "readme.txt").write_text("no picture")
    return root


def test_dicom_series_take_setting_and_instrument_from_their_tags(radiographs, tmp_path, json_of):
    account = json_of("import", "dicom", radiographs, "-o", tmp_path / "s.h5")
    assert account["frames"] == 9 and layout_of(radiographs) == "dicom"
    with open_acquisition(tmp_path / "s.h5") as session:
        dark, flat, high, part = session.series
        assert [one.kind for one in session.series] == ["dark", "flat", "flat", "object"]
        assert (dark.kV, dark.exposure_ms, dark.n_frames) == (None, 20, 3)
        np.testing.assert_array_equal(flat.read_frames(), [picture(21), picture(22), picture(30)])
        assert (flat.kV, flat.current_mA, flat.exposure_ms) == (40, 1, 20)
        assert flat.filters == (Filter(material="Cu", thickness_mm=0.05), Filter(material="Al", thickness_mm=1.0))
        np.testing.assert_allclose([*dark.time_s, *flat.time_s], [0, 1, 9, 60, 61, 69])
        assert (high.kV, high.current_mA) == (90, 0.5)
        np.testing.assert_array_equal(part.read_frames(), [picture(41), picture(42)])
        assert (part.scene, part.frame_interval_ms) == ("castings", 25)
        instrument = session.instrument
        assert (instrument.anode, instrument.pixel_mm, instrument.bits) == ("W", 0.15, 14)
        assert (instrument.source_detector_mm, instrument.source_object_mm, instrument.focal_spot_mm) == (
            1059,
            990,
            0.4,
        )
    assert b"Secret" not in (tmp_path / "s.h5").read_bytes()


def test_rescaled_and_falling_dicom_values_become_numbers_that_rise_with_the_beam(tmp_path):
    values = picture()
    shown = write_dicom(tmp_path / "shown.dcm", values, PhotometricInterpretation="MONOCHROME1")
    np.testing.assert_array_equal(read_image(shown), values)
    scaled = write_dicom(tmp_path / "scaled.dcm", values, RescaleSlope="2.5", RescaleIntercept="-100")
    np.testing.assert_allclose(read_image(scaled), 2.5 * values.astype(float) - 100)
    falling = write_dicom(
        tmp_path / "falling.dcm", values, RescaleSlope="2", RescaleIntercept="7", PixelIntensityRelationshipSign=-1
    )
    np.testing.assert_allclose(read_image(falling), 2.0 * (2**14 - 1 - values.astype(float)))


def test_exposure_follows_from_tube_load_and_what_is_unclear_is_told(tmp_path):
    path = write_dicom(
        tmp_path / "a.dcm",
        picture(),
        XRayTubeCurrent="2",
        ExposureInuAs="500",
        FilterMaterial="KRYPTONITE",
        FilterThicknessMinimum="1",
        NumberOfFramesIntegrated="4",
        LossyImageCompression="01",
    )
    header = read_image_header(path)
    assert (header.exposure_ms, header.averaged, header.filters) == (250, 4, None)
    assert [word for word in ("KRYPTONITE", "4 frames integrated", "lossy") if word in " ".join(header.notes)] == [
        "KRYPTONITE",
        "4 frames integrated",
        "lossy",
    ]


def test_dicom_files_that_cannot_be_used_are_one_line(tmp_path, refused_import):
    whole = write_dicom(tmp_path / "whole" / "a.dcm", picture()).read_bytes()
    write_dicom(tmp_path / "log" / "a.dcm", picture(), PixelIntensityRelationship="LOG")
    for name, data in (("cut", whole[:-60]), ("tags", whole[:300]), ("text", b"no DICOM at all")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.dcm").write_bytes(data)
        assert "a.dcm" in refused_import("dicom", tmp_path / name, out=tmp_path / "o.h5")
    assert "Relationship LOG; expected LIN" in refused_import("dicom", tmp_path / "log", out=tmp_path / "o.h5")
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "a.txt").write_text("")
    assert "none of them DICOM" in refused_import("dicom", tmp_path / "none", out=tmp_path / "o.h5")


def test_a_sidecar_goes_before_the_tags_and_one_series_holds_one_setting(tmp_path, refused_import, json_of):
    folder = tmp_path / "session"
    for number, kV in enumerate(("40", "90")):
        write_dicom(folder / f"f{number}.dcm", picture(number), **{**TAGS, "KVP": kV})
    sidecar = '[instrument]\npixel_mm = 0.2\n[[series]]\nkind = "flat"\nfiles = "*.dcm"\n'
    (folder / "raytwin.toml").write_text(sidecar)
    line = refused_import("images", folder, out=tmp_path / "o.h5")
    assert "40.0 and 90.0 in the headers" in line and "split the series" in line
    (folder / "raytwin.toml").write_text(sidecar + "kV = 60\n")
    account = json_of("import", "images", folder, "-o", tmp_path / "o.h5")
    with open_acquisition(tmp_path / "o.h5") as session:
        (flat,) = session.series
        assert (flat.kV, flat.current_mA, flat.exposure_ms) == (60, 1, 20)
        assert (session.instrument.pixel_mm, session.instrument.source_detector_mm) == (0.2, 1059)
    assert any("pixel_mm: 0.2 in the sidecar, 0.15" in note for note in account["notes"])


# EDF and other formats of fabio


def test_edf_and_cbf_come_in_with_their_exposure(tmp_path, refused_import, json_of):
    pytest.importorskip("fabio", reason="EDF files need the extra `fabio`")
    from fabio.cbfimage import CbfImage
    from fabio.edfimage import EdfImage

    folder = tmp_path / "beamline"
    folder.mkdir()
    stack = EdfImage(data=picture(1), header={"ExposureTime": "0.25", "PSize_1": "6.5e-06"})
    stack.append_frame(data=picture(2), header={"ExposureTime": "0.25"})
    stack.write(str(folder / "flat.edf"))
    contents = "\r\n# Exposure_time 0.0950 s\r\n# Exposure_period 0.1 s\r\n# Pixel_size 172e-6 m x 172e-6 m\r\n"
    CbfImage(data=picture(3, dtype=np.int32), header={"_array_data.header_contents": contents}).write(
        str(folder / "sample.cbf")
    )
    sidecar = '[[series]]\nkind = "flat"\nfiles = "*.edf"\n[[series]]\nkind = "object"\nfiles = "*.cbf"\n'
    (folder / "raytwin.toml").write_text(sidecar)
    account = json_of("import", "images", folder, "-o", tmp_path / "o.h5")
    with open_acquisition(tmp_path / "o.h5") as session:
        flat, sample = session.series
        np.testing.assert_array_equal(flat.read_frames(), [picture(1), picture(2)])
        np.testing.assert_array_equal(sample.read_frames(), [picture(3)])
        assert (flat.exposure_ms, sample.exposure_ms, sample.frame_interval_ms) == (250, 95, 100)
        assert session.instrument.pixel_mm is None
    assert any("pixel_mm" in note and "neither is taken" in note for note in account["notes"])
    whole = (folder / "flat.edf").read_bytes()
    (folder / "flat.edf").write_bytes(whole[: len(whole) - 300])
    assert "flat.edf" in refused_import("images", folder, out=tmp_path / "p.h5")
    (folder / "flat.edf").write_bytes(whole)
    (folder / "sample.cbf").write_bytes((folder / "sample.cbf").read_bytes()[:250])
    assert "no binary section" in refused_import("images", folder, out=tmp_path / "p.h5")


# HIS of Varex panels


def his(frames, *, number_type=4, correction=0, time_us=66500.0, kind=0x7000):
    frames = np.asarray(frames)
    count, rows, columns = frames.shape
    numbers = {4: "<u2", 128: "<f4"}.get(number_type, "<u2")
    data = frames.astype(numbers).tobytes()
    head = struct.pack(
        "<HHHIHHHHHHHdH34x",
        kind,
        68,
        100,
        100 + len(data),
        32,
        1,
        1,
        columns,
        rows,
        count,
        correction,
        time_us,
        number_type,
    )
    assert len(head) == 68
    return head + bytes(32) + data


def test_his_files_give_frames_frame_time_and_corrections(tmp_path, json_of):
    frames = np.stack([picture(1), picture(2)])
    folder = tmp_path / "panel"
    folder.mkdir()
    (folder / "flat.his").write_bytes(his(frames))
    (folder / "object.his").write_bytes(his(frames * 0.5, number_type=128, correction=3))
    text = '[[series]]\nkind = "flat"\nfiles = "flat.his"\nkV = 40\n[[series]]\nkind = "object"\nfiles = "object.his"\n'
    (folder / "raytwin.toml").write_text(text)
    json_of("import", "images", folder, "-o", tmp_path / "o.h5")
    with open_acquisition(tmp_path / "o.h5") as session:
        flat, seen = session.series
        np.testing.assert_array_equal(flat.read_frames(), frames)
        np.testing.assert_array_equal(seen.read_frames(), frames * np.float32(0.5))
        assert (flat.kV, flat.exposure_ms, flat.corrected) == (40, 66.5, frozenset())
        assert seen.corrected == {"offset", "gain"}


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (his(picture()[None])[:-1], "1 frames of 12 x 17 uint16"),
        (his(picture()[None], kind=0x1234), "file type 0x1234"),
        (his(picture()[None], number_type=7), "numbers of type 7"),
        (b"short", "a HIS header of 68 bytes"),
    ],
)
def test_his_files_of_another_form_say_what_is_wrong(tmp_path, data, told):
    (tmp_path / "a.his").write_bytes(data)
    with pytest.raises(FileFormatError, match=told):
        list(iter_images(tmp_path / "a.his"))


# Nikon scans

XTEKCT = """[XTekCT]
Name=jar scan
Projections=3
SrcToObject=183.012
SrcToDetector=735.7075
DetectorPixelSizeX=0.2
WhiteLevel=60000.0

[Xrays]
XraykV=216
XrayuA=229

[CTPro]
Filter_ThicknessMM=1.0
Filter_Material=Copper
"""


@pytest.fixture
def scan(tmp_path):
    folder = tmp_path / "scan"
    folder.mkdir()
    (folder / "jar scan.xtekct").write_text(XTEKCT)
    for number in (1, 2, 3):
        tifffile.imwrite(folder / f"jar scan_{number:04d}.tif", picture(number))
    return folder


def test_a_nikon_scan_becomes_a_series_of_corrected_projections(scan, tmp_path, json_of):
    account = json_of("import", "xtekct", scan, "--exposure-ms", "500", "-o", tmp_path / "o.h5")
    assert account["skipped"] == [] and layout_of(scan) == "xtekct"
    with open_acquisition(tmp_path / "o.h5") as session:
        (series,) = session.series
        np.testing.assert_array_equal(series.read_frames(), [picture(1), picture(2), picture(3)])
        assert (series.kV, series.current_mA, series.exposure_ms) == (216, 0.229, 500)
        assert series.filters == (Filter(material="Cu", thickness_mm=1.0),)
        assert series.corrected == {"offset", "gain"} and series.scene == "jar_scan"
        assert (session.instrument.pixel_mm, session.instrument.source_detector_mm) == (0.2, 735.7075)
    (scan / "jar scan_0002.tif").unlink()
    account = json_of("import", "xtekct", scan, "-o", tmp_path / "o.h5")
    assert "3 projections announced, 2 found" in account["skipped"][0]["reason"]
    assert any("--exposure-ms" in note for note in account["notes"])


def test_a_nikon_scan_that_cannot_be_used_is_one_line(scan, tmp_path, refused_import):
    for path in scan.glob("*.tif"):
        path.unlink()
    assert "no files jar scan_0001.tif" in refused_import("xtekct", scan, out=tmp_path / "o.h5")
    for text, told in (("[Other]\na=1\n", "[XTekCT] among them"), ("no section", "a text of another form")):
        (scan / "jar scan.xtekct").write_text(text)
        assert told in refused_import("xtekct", scan, out=tmp_path / "o.h5")


# TIFF with a scale


def test_the_pixel_size_of_ome_and_imagej_files_is_read_and_print_resolutions_are_not(tmp_path, json_of):
    folder = tmp_path / "pictures"
    folder.mkdir()
    metadata = {"axes": "YX", "PhysicalSizeX": 0.15, "PhysicalSizeXUnit": "mm"}
    tifffile.imwrite(folder / "ome.ome.tif", picture(1), ome=True, metadata=metadata)
    tifffile.imwrite(folder / "micro.ome.tif", picture(1), ome=True, metadata={"axes": "YX", "PhysicalSizeX": 150.0})
    tifffile.imwrite(
        folder / "imagej.tif", picture(1), imagej=True, resolution=(1 / 0.15, 1 / 0.15), metadata={"unit": "mm"}
    )
    tifffile.imwrite(folder / "print.tif", picture(1), resolution=(72, 72), resolutionunit="INCH")
    for name in ("ome.ome.tif", "micro.ome.tif", "imagej.tif"):
        assert read_image_header(folder / name).pixel_mm == pytest.approx(0.15, rel=1e-6), name
    assert read_image_header(folder / "print.tif").pixel_mm is None
    (folder / "raytwin.toml").write_text('[[series]]\nkind = "flat"\nfiles = "*.tif"\n')
    json_of("import", "images", folder, "-o", tmp_path / "o.h5")
    with open_acquisition(tmp_path / "o.h5") as session:
        assert session.instrument.pixel_mm == pytest.approx(0.15)
