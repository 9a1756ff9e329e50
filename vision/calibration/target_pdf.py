"""The target as a vector PDF in its true size, with rulers that show whether it was printed so."""

from mapweave.hybridmap.errors import InvalidValue
from mapweave.vision.calibration.target import CalibrationTarget

PAPERS = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4), "legal": (215.9, 355.6)}
"""Width and height, mm."""
POINTS = 72.0 / 25.4
"""PDF's unit, points, a millimetre."""
EDGE = 6.0
"""mm at the paper's edge on which printers print nothing."""
RULER = 14.0
"""mm that a ruler with its numbers takes."""
CAPTION = 10.0
"""mm for two lines of text."""


def target_pdf(target: CalibrationTarget, paper: str) -> bytes:
    """One page. Nothing in it depends on the day: the same target gives the same bytes.

    Args:
        target: to print.
        paper: one of `PAPERS`.

    Raises:
        InvalidValue: it does not fit on the paper.
    """
    page_width, page_height = PAPERS[paper]
    width, height = (1e3 * side for side in target.size)
    room = page_width - 2 * EDGE - RULER, page_height - 2 * EDGE - RULER - CAPTION
    if width > room[0] or height > room[1]:
        raise InvalidValue(
            f"target: {width:g} x {height:g} mm do not fit on {paper}, which has {room[0]:.0f} x "
            f"{room[1]:.0f} mm for it; take smaller or fewer squares"
        )
    # PDF counts upwards from the lower left corner.
    left = EDGE + RULER + (room[0] - width) / 2
    low = EDGE + RULER + CAPTION + (room[1] - height) / 2
    top = low + height
    lines = [f"{POINTS:.9f} 0 0 {POINTS:.9f} 0 0 cm", "0 g"]
    lines += [
        f"{left + 1e3 * r.x:.4f} {top - 1e3 * (r.y + r.height):.4f} "
        f"{1e3 * r.width:.4f} {1e3 * r.height:.4f} re"
        for r in target.rectangles()
    ]
    lines += ["f", "0.15 w", *_ruler(left, low - 3.0, width, upright=False)]
    lines += _ruler(left - 3.0, low, height, upright=True)
    text = low - 3.0 - RULER
    lines += [
        _text(left, text, 3.5, f"mapweave: {target}"),
        _text(left, text - 5.0, 3.5, "Print at 100 %, not fitted to the page. Check both scales (mm)."),
    ]  # fmt: skip
    return _document("\n".join(lines).encode("ascii"), page_width * POINTS, page_height * POINTS)


def _ruler(x: float, y: float, length: float, upright: bool) -> list[str]:
    """Lines each mm, longer ones each 5 and 10 mm, numbers each 20 mm. It grows away from the board."""
    whole = int(length // 10) * 10
    lines = []
    for mm in range(whole + 1):
        tick = 5.0 if mm % 10 == 0 else 3.5 if mm % 5 == 0 else 2.0
        ends = (x, y + mm, x - tick, y + mm) if upright else (x + mm, y, x + mm, y - tick)
        lines.append("{:.4f} {:.4f} m {:.4f} {:.4f} l S".format(*ends))
        if mm % 20 == 0:
            at = (x - 10.0, y + mm - 0.9) if upright else (x + mm - 1.5, y - 8.0)
            lines.append(_text(*at, 2.5, f"{mm}"))
    return lines


def _text(x: float, y: float, size: float, text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
    return f"BT /F1 {size:g} Tf {x:.4f} {y:.4f} Td ({escaped}) Tj ET"


def _document(content: bytes, width: float, height: float) -> bytes:
    """A PDF 1.4 of one page: catalogue, pages, page, font and content, with the table of their places."""
    box = f"[0 0 {width:.4f} {height:.4f}]"
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox {box} /Contents 5 0 R "
        "/Resources << /Font << /F1 4 0 R >> >> >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
    ]
    out, places = bytearray(b"%PDF-1.4\n"), []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    end = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n%s" % (len(objects) + 1, table)
    out += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, end)
    return bytes(out)
