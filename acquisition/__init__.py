"""What was measured: settings, the instrument, acquisition and dataset files, and the pairs made of them.

Files:
    setting               tube voltage, load, filter, exposure, and their text form
    instrument            the line as its owner describes it
    acquisition_io        the acquisition file; _acquisition_words: its words
    acquisition_writer    series and scenes as they are written
    scenes                what stood in the beam
    instrument_io         the instrument in a file
    dataset_io            the dataset file
    pairs                 dark and flat correction, pairs by scene
    contrast              contrast of a foreign object in a pair
    sessions              several sessions as one; one layer of a dual-layer panel
    series_roles          which series of a session calibrate
    binned_frames         frames and maps of binned pixels
    log_images            frames of I/I0 or its logarithm as light
    cut_off               frames that end at 0
    import_any            the layout of a folder, and a sidecar to start from
    import_report         what an import read and skipped
    images                folders of images with a sidecar
    nxtomo, dicom, emva1288, xtekct, zenodo, reference
                          one importer each
    image_header          what an image file says of its setting
    export_acquisition    DICONDE, NXtomo, TIFF
    export_dataset        COCO, YOLO, TIFF
    export_zarr           Zarr groups
    tiff_folder           the folders of the paper's data
    tiff_tags             TIFF with pixel pitch and setting
    mask_shapes           masks as boxes, run lengths and outlines
    _image_files          reading of image formats; _dicom_files, _fabio_files, _his_files: one format each
    _image_header         words of headers; _tiff_header: those of TIFF
    _picture_checks       what every reader asks of a picture
    _sidecar              the sidecar's words
    _hdf5                 faults of HDF5 files

Names that need h5py or scipy are loaded when they are first asked for.
"""

import importlib
from typing import TYPE_CHECKING, Any

from .instrument import Instrument
from .setting import Filter, Setting, filter_from_text, filters_from_text, setting_from_text, text_from_filters

if TYPE_CHECKING:
    from .acquisition_io import (
        AcquisitionFile,
        Series,
        open_acquisition,
        write_acquisition,
    )
    from .acquisition_writer import AcquisitionWriter, SeriesWriter
    from .contrast import (
        delta_r,
        dilations_for_pixel,
    )
    from .dataset_io import (
        Dataset,
        DatasetRow,
        DatasetWriter,
        concatenate_datasets,
        read_dataset,
        write_dataset,
        write_selected,
    )
    from .pairs import (
        DatasetSummary,
        ObjectPair,
        PairCorrector,
        dataset_from_acquisition,
        flat_corrected_log,
        matching_darks,
        matching_flats,
        mean_of_frames,
        object_pairs,
        replace_bad_pixels,
        split_by_product,
        unpaired_objects,
    )
    from .scenes import Scene

_LAZY = {
    "DatasetSummary": "pairs",
    "ObjectPair": "pairs",
    "PairCorrector": "pairs",
    "dataset_from_acquisition": "pairs",
    "flat_corrected_log": "pairs",
    "matching_darks": "pairs",
    "matching_flats": "pairs",
    "mean_of_frames": "pairs",
    "object_pairs": "pairs",
    "replace_bad_pixels": "pairs",
    "split_by_product": "pairs",
    "unpaired_objects": "pairs",
    "delta_r": "contrast",
    "dilations_for_pixel": "contrast",
    "AcquisitionFile": "acquisition_io",
    "AcquisitionWriter": "acquisition_writer",
    "Scene": "scenes",
    "Series": "acquisition_io",
    "SeriesWriter": "acquisition_writer",
    "open_acquisition": "acquisition_io",
    "write_acquisition": "acquisition_io",
    "Dataset": "dataset_io",
    "DatasetRow": "dataset_io",
    "DatasetWriter": "dataset_io",
    "concatenate_datasets": "dataset_io",
    "read_dataset": "dataset_io",
    "write_dataset": "dataset_io",
    "write_selected": "dataset_io",
}

__all__ = [
    "AcquisitionFile",
    "AcquisitionWriter",
    "Dataset",
    "DatasetRow",
    "DatasetSummary",
    "DatasetWriter",
    "Filter",
    "Instrument",
    "ObjectPair",
    "PairCorrector",
    "Scene",
    "Series",
    "SeriesWriter",
    "Setting",
    "concatenate_datasets",
    "dataset_from_acquisition",
    "delta_r",
    "dilations_for_pixel",
    "filter_from_text",
    "filters_from_text",
    "flat_corrected_log",
    "matching_darks",
    "matching_flats",
    "mean_of_frames",
    "object_pairs",
    "open_acquisition",
    "read_dataset",
    "replace_bad_pixels",
    "setting_from_text",
    "split_by_product",
    "text_from_filters",
    "unpaired_objects",
    "write_acquisition",
    "write_dataset",
    "write_selected",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_LAZY[name]}", __name__), name)
