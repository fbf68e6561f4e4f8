"""The arithmetic of `integers` in C99, line for line: signed 64-bit integers, no floating point, no library.

Shifts to the right of what is negative are spelled out, since C leaves them to the compiler.
"""

from __future__ import annotations

from flowgraph.engines.fixed import integers as z
from flowgraph.pipeline.formats import NOT_A_NUMBER

_HEAD = """
#define FX_LIMIT ((int64_t)1 << 62)
#define FX_NAN (-FX_LIMIT)
#define FX_LEAST (1 - FX_LIMIT)
#define FX_QUARTER_TURNS INT64_C({turn})
#define FX_QUARTER INT64_C({quarter})
#define FX_LOG2_E INT64_C({log2_e})
#define FX_LN_2 INT64_C({ln_2})
#define FX_HALF_TURN INT64_C({half})
static const int64_t fx_sinc[] = {{{sinc}}};
static const int64_t fx_cosine[] = {{{cosine}}};
static const int64_t fx_power[] = {{{power}}};
static const int64_t fx_angles[] = {{{angles}}};
"""

_BODY = r"""
static inline int64_t fx_down(int64_t x, int n) { return x >= 0 ? x >> n : ~(~x >> n); }
static inline int64_t fx_cut(int64_t x, int64_t most) { return x > most ? most : x < -most ? -most : x; }
static inline int64_t fx_abs(int64_t x) { return x < 0 ? -x : x; }

static inline int64_t fx_upper(int64_t x, int n) {
  if (x == FX_NAN) return x;
  x = fx_down(x + ((int64_t)1 << (n - 1)), n);
  return x > INT32_MAX ? INT32_MAX : x;
}

static FX_CALL int64_t fx_shift(int64_t x, int64_t by) {
  if (by == 0) return x;
  if (by > 62) return 0;
  if (by > 0) return fx_down(x + (((int64_t)1 << by) >> 1), (int)by);
  if (by < -62) by = -62;
  x = fx_cut(x, FX_LIMIT >> -by) * ((int64_t)1 << -by);
  return x < FX_LEAST ? FX_LEAST : x;
}

static inline int fx_bits(int64_t x) {
  int n = 0;
  for (int s = 32; s; s >>= 1) if (x >> s) { n += s; x >>= s; }
  return n + (x != 0);
}

static inline int64_t fx_lost(int64_t x, int is_not_zero, int64_t *count) {
  if (x == 0 && is_not_zero) ++*count;
  return x;
}

static FX_CALL int64_t fx_quotient(int64_t a, int64_t b, int64_t up) {
  if (a == 0) return 0;
  int64_t over = fx_abs(a), under = fx_abs(b), q = -FX_LEAST;
  if (b != 0) {
    int lift_a = 62 - fx_bits(over), lift_b = 31 - fx_bits(under);
    q = fx_shift((over << lift_a) / (under << lift_b), lift_a - lift_b - up);
  }
  if (q > -FX_LEAST) q = -FX_LEAST;
  return (a < 0) != (b < 0) ? -q : q;
}

static FX_CALL int64_t fx_root_of(int64_t x) {
  int64_t r = 0;
  for (int64_t bit = (int64_t)1 << 62; bit; bit >>= 2) {
    int64_t t = r + bit;
    r >>= 1;
    if (x >= t) { x -= t; r += bit; }
  }
  return r;
}

static FX_CALL int64_t fx_square_root(int64_t x, int64_t fraction, int64_t out) {
  int64_t lift;
  if (x <= 0) return 0;
  lift = 62 - fx_bits(x);
  lift -= (fraction + lift) & 1;
  return fx_shift(fx_root_of(x << lift), fx_down(fraction + lift, 1) - out);
}

static FX_CALL int64_t fx_horner(const int64_t *c, int n, int64_t u) {
  int64_t total = c[n - 1];
  for (int k = n - 2; k >= 0; --k) total = fx_down(total * u + (1 << 29), 30) + c[k];
  return total;
}

static FX_CALL int64_t fx_sine(int64_t x, int64_t fraction, int64_t out, int ahead) {
  int64_t turns = fx_shift(x * FX_QUARTER_TURNS, fraction + 1);
  int64_t n = fx_down(turns + (1 << 29), 30);
  int64_t r = turns - n * ((int64_t)1 << 30);
  int64_t u = fx_down(r * r + (1 << 29), 30), value;
  if ((n + ahead) & 1) value = fx_shift(fx_horner(fx_cosine, 7, u), 30 - out);
  else if (n == 0 && ahead == 0) value = fx_shift(x * fx_horner(fx_sinc, 6, u), fraction + 30 - out);
  else value = fx_shift(fx_down(r * FX_QUARTER + (1 << 29), 30) * fx_horner(fx_sinc, 6, u), 60 - out);
  return (n + ahead) & 2 ? -value : value;
}

static FX_CALL int64_t fx_sine_over(int64_t x, int64_t fraction, int64_t out) {
  int64_t turns = fx_shift(x * FX_QUARTER_TURNS, fraction + 1);
  if (fx_down(turns + (1 << 29), 30) != 0)
    return fx_quotient(fx_sine(x, fraction, 30, 0), x, out + fraction - 30);
  return fx_shift(fx_horner(fx_sinc, 6, fx_down(turns * turns + (1 << 29), 30)), 30 - out);
}

static FX_CALL int64_t fx_exponential(int64_t x, int64_t fraction, int64_t out) {
  int64_t y = fx_shift(x * FX_LOG2_E, fraction);
  int64_t n = fx_down(y + (1 << 29), 30);
  return fx_shift(fx_horner(fx_power, 9, y - n * ((int64_t)1 << 30)), 30 - n - out);
}

static FX_CALL int64_t fx_logarithm(int64_t x, int64_t fraction, int64_t out) {
  int length = fx_bits(x > 1 ? x : 1);
  int64_t m = fx_shift(x > 1 ? x : 1, length - 31), y = 0;
  if (x <= 0) return FX_LEAST;
  for (int k = 1; k <= 30; ++k) {
    m = (m * m) >> 30;
    if (m >> 31) { y += (int64_t)1 << (30 - k); m >>= 1; }
  }
  return fx_shift((length - 1 - fraction) * FX_LN_2 + fx_down(y * FX_LN_2 + (1 << 29), 30), 30 - out);
}

static FX_CALL int64_t fx_angle(int64_t y, int64_t x, int64_t fraction_y, int64_t fraction_x, int64_t out) {
  int64_t top_y = fx_bits(fx_abs(y)) - fraction_y, top_x = fx_bits(fx_abs(x)) - fraction_x;
  int64_t top = top_y > top_x ? top_y : top_x, turned = 0;
  int64_t up = fx_shift(y, fraction_y - (59 - top)), along = fx_shift(x, fraction_x - (59 - top));
  if (y == 0) return x < 0 ? fx_shift(FX_HALF_TURN, 60 - out) : 0;
  if (along < 0) {
    turned = up < 0 ? -FX_HALF_TURN : FX_HALF_TURN;
    along = -along;
    up = -up;
  }
  for (int k = 0; k < FX_STEPS; ++k) {
    int64_t step_x = fx_down(up, k), step_y = fx_down(along, k);
    if (up > 0) { along += step_x; up -= step_y; turned += fx_angles[k]; }
    else { along -= step_x; up += step_y; turned -= fx_angles[k]; }
  }
  return fx_shift(turned, 60 - out);
}

static FX_CALL int64_t fx_length(int64_t a, int64_t b, int64_t fraction_a, int64_t fraction_b, int64_t out) {
  int64_t top_a = fx_bits(fx_abs(a)) - fraction_a, top_b = fx_bits(fx_abs(b)) - fraction_b;
  int64_t top = top_a > top_b ? top_a : top_b;
  int64_t p = fx_shift(a, fraction_a - (30 - top)), q = fx_shift(b, fraction_b - (30 - top));
  return fx_shift(fx_root_of(p * p + q * q), (30 - top) - out);
}

static FX_CALL int64_t fx_whole(int64_t x, int64_t fraction, int how) {
  /* 0 floor, 1 ceil, 2 trunc, 3 round */
  int f = fraction < 0 ? 0 : fraction > 62 ? 62 : (int)fraction;
  if (fraction < 0) x = fx_shift(x, fraction < -62 ? -62 : fraction);
  if (how == 1 || (how == 2 && x < 0)) return -fx_down(-x, f);
  if (how == 3) {
    int64_t low = fx_down(x, f), rest = (x - low * ((int64_t)1 << f)) * 2, one = (int64_t)1 << f;
    return low + (rest > one || (rest == one && (low & 1)));
  }
  return fx_down(x, f);
}

static FX_CALL int64_t fx_floor_divide(int64_t a, int64_t b) {
  if (b == 0) return 0;
  int64_t q = a / b;
  return q - (a % b != 0 && (a < 0) != (b < 0));
}

static FX_CALL int64_t fx_remainder(int64_t a, int64_t b) {
  if (b == 0) return 0;
  int64_t r = a % b;
  return r != 0 && (r < 0) != (b < 0) ? r + b : r;
}

static FX_CALL int64_t fx_float32_bits(int64_t x) {
  int64_t size = fx_abs(x), low, rest;
  int n = fx_bits(size), cut = n - 24;
  if (x == 0) return 0;
  if (cut > 0) {
    low = size >> cut;
    rest = size & (((int64_t)1 << cut) - 1);
    low += rest > (int64_t)1 << (cut - 1) || (rest == (int64_t)1 << (cut - 1) && (low & 1));
    if (low >> 24) { low >>= 1; ++n; }
  } else low = size << -cut;
  low = ((int64_t)(n + 126) << 23) + (low - ((int64_t)1 << 23));
  return x < 0 ? low - ((int64_t)1 << 31) : low;
}
"""


_MARKED = r"""
static inline int64_t fx_fit(int64_t x, uint8_t *off, int place, int64_t most) { /* or the largest, marked */
  if (x == FX_NAN || (x <= most && x >= -most)) return x;
  off[place] |= 1;
  off[FX_SIZE] = 1;
  return x > 0 ? most : -most;
}
#define FX_FIT(x, place) fx_fit(x, off, place, FX_MOST)
#define FX_MARK(place, why) (off[place] |= (why), off[FX_SIZE] = 1)
"""

_COUNTED = r"""
static inline int64_t fx_fit(int64_t x, int64_t *count, int64_t most) { /* or the largest, counted */
  if (x == FX_NAN || (x <= most && x >= -most)) return x;
  ++*count;
  return x > 0 ? most : -most;
}
"""


def _list(numbers: list[int]) -> str:
    return ", ".join(f"INT64_C({n})" for n in numbers)


def kernels(most: int, size: int | None, *, tabled: bool = False) -> str:
    """The text, with the constants of `integers`, and the largest word.

    Args:
        most: that.
        size: the number of words that are kept, and marked where they are cut; None where this is counted.
        tabled: whether shifts and the largest words are in memory; functions of these are called, not written
            into their callers, or a compiler would be long about it.
    """
    assert NOT_A_NUMBER == -z.LIMIT
    head = _HEAD.format(
        turn=z.QUARTER_TURNS, quarter=z.QUARTER, log2_e=z.LOG2_E, ln_2=z.LN_2, half=z.HALF_TURN,
        sinc=_list(z.SINC), cosine=_list(z.COSINE), power=_list(z.POWER), angles=_list(z.ANGLES),
    )  # fmt: skip
    sizes = f"#define FX_STEPS {len(z.ANGLES)}"
    sizes += f"\n#define FX_CALL {'__attribute__((noinline, unused))' if tabled else 'inline'}"
    if tabled:
        sizes += f"\n#define FX_SIZE {size}\nconst int16_t *fx_s;\nconst int64_t *fx_m;"
    elif size is not None:
        sizes += f"\n#define FX_MOST INT64_C({most})\n#define FX_SIZE {size}"
    return f"#include <stdint.h>\n{head}{sizes}\n{_BODY}{_COUNTED if size is None else _MARKED}"
