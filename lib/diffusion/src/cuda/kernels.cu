// Kernels of the layers for an NVIDIA GPU. T is what is stored: float, half or bfloat16; sums are float.
// Every array is contiguous. A kernel's name carries its type: norm_apply_bf16.
#include <cuda_bf16.h>
#include <cuda_fp16.h>

typedef long long i64;

__device__ inline float wide(float v) { return v; }
__device__ inline float wide(__half v) { return __half2float(v); }
__device__ inline float wide(__nv_bfloat16 v) { return __bfloat162float(v); }

__device__ inline void put(float *to, float v) { *to = v; }
__device__ inline void put(__half *to, float v) { *to = __float2half_rn(v); }
__device__ inline void put(__nv_bfloat16 *to, float v) { *to = __float2bfloat16_rn(v); }

// V values that are read and written at once.
template <typename T, int V> struct alignas(sizeof(T) * V < 16 ? sizeof(T) * V : 16) Pack {
    T v[V];
};

template <int V, typename T> __device__ inline Pack<T, V> get(const T *from) {
    return *reinterpret_cast<const Pack<T, V> *>(from);
}

template <int V, typename T> __device__ inline void set(T *to, const Pack<T, V> &pack) {
    *reinterpret_cast<Pack<T, V> *>(to) = pack;
}

struct Sum {
    static __device__ float start() { return 0.0f; }
    static __device__ float join(float a, float b) { return a + b; }
};

struct Largest {
    static __device__ float start() { return -INFINITY; }
    static __device__ float join(float a, float b) { return fmaxf(a, b); }
};

// Joins v over the block, for all threads; the block has whole warps.
template <typename Op> __device__ float reduce(float v) {
    __shared__ float parts[32];
    for (int o = 16; o > 0; o >>= 1) v = Op::join(v, __shfl_xor_sync(0xffffffffu, v, o));
    __syncthreads(); // The reduction before this one may still be read.
    if ((threadIdx.x & 31) == 0) parts[threadIdx.x >> 5] = v;
    __syncthreads();
    float all = Op::start();
    for (int i = 0; i < blockDim.x / 32; i++) all = Op::join(all, parts[i]);
    return all;
}

// --- Normalisation -------------------------------------------------------------------------------------------------
// Rows of n values are cut into chunks: blockIdx.x is the row, blockIdx.y the chunk.

struct Chunk {
    i64 row;
    int begin, end, index;
};

__device__ Chunk this_chunk(int n, int chunk) {
    Chunk c;
    c.row = blockIdx.x;
    c.begin = blockIdx.y * chunk;
    c.end = min(c.begin + chunk, n);
    c.index = blockIdx.x * gridDim.y + blockIdx.y;
    return c;
}

// Mean, and sum of squares about it, of every chunk. Here and below each thread takes V values, one after the other, at once.
template <typename T, int V> __device__ void norm_sums(const T *x, float *parts, int n, int chunk) {
    Chunk c = this_chunk(n, chunk);
    const T *values = x + c.row * n;
    float sum = 0.0f, squares = 0.0f;
    for (int i = c.begin + V * threadIdx.x; i < c.end; i += V * blockDim.x) {
        Pack<T, V> at = get<V>(values + i);
        for (int k = 0; k < V; k++) sum += wide(at.v[k]);
    }
    float mean = reduce<Sum>(sum) / (c.end - c.begin);
    for (int i = c.begin + V * threadIdx.x; i < c.end; i += V * blockDim.x) {
        Pack<T, V> at = get<V>(values + i);
        for (int k = 0; k < V; k++) {
            float d = wide(at.v[k]) - mean;
            squares += d * d;
        }
    }
    squares = reduce<Sum>(squares);
    if (threadIdx.x == 0) {
        parts[2 * c.index] = mean;
        parts[2 * c.index + 1] = squares;
    }
}

struct Norm {
    int n, chunk, groups, per_group, pixels, silu;
    float eps;
};

// What some values of a row become. Their channel is that of the group's first, plus their place over the pixels of a
// channel; with V > 1 they are of one channel, or each is of one of its own.
template <typename T, int V> struct Row {
    const T *gamma, *beta;
    int pixels, silu;
    float mean, scale, normal[V], slope[V], shift[V];

    // Statistics from those of the chunks [Chan et al. 1979].
    __device__ Row(const T *gamma_, const T *beta_, const float *parts, Norm s) {
        i64 row = blockIdx.x;
        float count = 0.0f, squares = 0.0f;
        mean = 0.0f;
        for (int c = 0; c < gridDim.y; c++) {
            const float *part = parts + 2 * (row * gridDim.y + c);
            float more = min(s.chunk, s.n - c * s.chunk), total = count + more, d = part[0] - mean;
            mean += d * (more / total);
            squares += part[1] + d * d * (count * (more / total));
            count = total;
        }
        scale = 1.0f / sqrtf(squares / s.n + s.eps);
        int first = (int)(row % s.groups) * s.per_group;
        gamma = gamma_ + first;
        beta = beta_ + first;
        pixels = s.pixels;
        silu = s.silu;
    }

    // Reads the values from place i of the row x on.
    __device__ void read(const T *x, int i) {
        Pack<T, V> at = get<V>(x + i);
        int channel = pixels == 1 ? i : i / pixels;
        for (int k = 0; k < V; k++) {
            normal[k] = (wide(at.v[k]) - mean) * scale;
            int own = pixels == 1 ? channel + k : channel;
            slope[k] = wide(gamma[own]);
            shift[k] = wide(beta[own]);
        }
    }

    __device__ float value(int k) const {
        float v = normal[k] * slope[k] + shift[k];
        return silu ? v / (1.0f + expf(-v)) : v;
    }

    // The gradient at normal[k], where that at the value is g.
    __device__ float back(int k, float g) const {
        if (silu) {
            float v = normal[k] * slope[k] + shift[k];
            float s = 1.0f / (1.0f + expf(-v));
            g *= s * (1.0f + v * (1.0f - s));
        }
        return g * slope[k];
    }
};

template <typename T, int V>
__device__ void norm_apply(const T *x, const T *gamma, const T *beta, const float *parts, T *y, Norm s) {
    Chunk c = this_chunk(s.n, s.chunk);
    Row<T, V> row(gamma, beta, parts, s);
    for (int i = c.begin + V * threadIdx.x; i < c.end; i += V * blockDim.x) {
        row.read(x + c.row * s.n, i);
        Pack<T, V> to;
        for (int k = 0; k < V; k++) put(to.v + k, row.value(k));
        set(y + c.row * s.n + i, to);
    }
}

// Sums of the gradient at the normalised values, plain and times these values, of every chunk.
template <typename T, int V>
__device__ void norm_vjp_sums(const T *x, const T *gamma, const T *beta, const float *parts, const T *g, float *sums,
                              Norm s) {
    Chunk c = this_chunk(s.n, s.chunk);
    Row<T, V> row(gamma, beta, parts, s);
    float plain = 0.0f, weighted = 0.0f;
    for (int i = c.begin + V * threadIdx.x; i < c.end; i += V * blockDim.x) {
        row.read(x + c.row * s.n, i);
        Pack<T, V> from = get<V>(g + c.row * s.n + i);
        for (int k = 0; k < V; k++) {
            float a = row.back(k, wide(from.v[k]));
            plain += a;
            weighted += a * row.normal[k];
        }
    }
    plain = reduce<Sum>(plain);
    weighted = reduce<Sum>(weighted);
    if (threadIdx.x == 0) {
        sums[2 * c.index] = plain;
        sums[2 * c.index + 1] = weighted;
    }
}

template <typename T, int V>
__device__ void norm_vjp(const T *x, const T *gamma, const T *beta, const float *parts, const T *g, const float *sums,
                         T *dx, Norm s) {
    Chunk c = this_chunk(s.n, s.chunk);
    Row<T, V> row(gamma, beta, parts, s);
    float plain = 0.0f, weighted = 0.0f;
    for (int k = 0; k < gridDim.y; k++) {
        const float *part = sums + 2 * (c.row * gridDim.y + k);
        plain += part[0];
        weighted += part[1];
    }
    plain /= s.n;
    weighted /= s.n;
    for (int i = c.begin + V * threadIdx.x; i < c.end; i += V * blockDim.x) {
        row.read(x + c.row * s.n, i);
        Pack<T, V> from = get<V>(g + c.row * s.n + i), to;
        for (int k = 0; k < V; k++) {
            float a = row.back(k, wide(from.v[k]));
            put(to.v + k, row.scale * (a - plain - row.normal[k] * weighted));
        }
        set(dx + c.row * s.n + i, to);
    }
}

// --- Attention -----------------------------------------------------------------------------------------------------

// A row of scores to weights. With `causal`, query q sees the keys up to q. A thread keeps V scores of each of up to HELD
// strides in registers; longer rows are read again.
constexpr int HELD = 12;

template <typename T, int V>
__device__ void softmax(const float *scores, T *p, int keys, int queries, int causal, float scale) {
    i64 row = blockIdx.x;
    const float *s = scores + row * keys;
    T *to = p + row * keys;
    int seen = causal ? min(keys, (int)(row % queries) + 1) : keys;
    int stride = V * blockDim.x, first = V * threadIdx.x;
    Pack<float, V> held[HELD];
    float largest = -INFINITY, sum = 0.0f;
#pragma unroll
    for (int h = 0; h < HELD; h++) {
        int i = first + h * stride;
        if (i < keys) held[h] = get<V>(s + i);
        for (int k = 0; k < V; k++)
            if (i + k < seen) largest = fmaxf(largest, held[h].v[k]);
    }
    for (int i = first + HELD * stride; i < seen; i += stride)
        for (int k = 0; k < V && i + k < seen; k++) largest = fmaxf(largest, s[i + k]);
    largest = reduce<Largest>(largest);
#pragma unroll
    for (int h = 0; h < HELD; h++) {
        int i = first + h * stride;
        for (int k = 0; k < V; k++) {
            held[h].v[k] = i + k < seen ? __expf(scale * (held[h].v[k] - largest)) : 0.0f;
            sum += held[h].v[k];
        }
    }
    for (int i = first + HELD * stride; i < seen; i += stride)
        for (int k = 0; k < V && i + k < seen; k++) sum += __expf(scale * (s[i + k] - largest));
    float share = 1.0f / reduce<Sum>(sum);
    Pack<T, V> out;
#pragma unroll
    for (int h = 0; h < HELD; h++) {
        int i = first + h * stride;
        if (i >= keys) continue;
        for (int k = 0; k < V; k++) put(out.v + k, held[h].v[k] * share);
        set(to + i, out);
    }
    for (int i = first + HELD * stride; i < keys; i += stride)
        for (int k = 0; k < V; k++)
            put(to + i + k, i + k < seen ? __expf(scale * (s[i + k] - largest)) * share : 0.0f);
}

// The gradient at the unscaled scores, where that at the weights p is g.
template <typename T, int V> __device__ void softmax_vjp(const T *p, const float *g, T *ds, int keys, float scale) {
    i64 at = (i64)blockIdx.x * keys;
    float dot = 0.0f;
    for (int i = V * threadIdx.x; i < keys; i += V * blockDim.x) {
        Pack<T, V> weight = get<V>(p + at + i);
        Pack<float, V> gradient = get<V>(g + at + i);
        for (int k = 0; k < V; k++) dot += wide(weight.v[k]) * gradient.v[k];
    }
    dot = reduce<Sum>(dot);
    for (int i = V * threadIdx.x; i < keys; i += V * blockDim.x) {
        Pack<T, V> weight = get<V>(p + at + i), to;
        Pack<float, V> gradient = get<V>(g + at + i);
        for (int k = 0; k < V; k++) put(to.v + k, scale * wide(weight.v[k]) * (gradient.v[k] - dot));
        set(ds + at + i, to);
    }
}

// --- Convolution ---------------------------------------------------------------------------------------------------
// Columns [inputs * kernel * kernel, rows * out_w] of the output's rows row0 .. row0 + rows. blockIdx.z is the image.

struct Window {
    int h, w, kernel, stride, pad, out_w, row0, rows;
};

// blockIdx.y is the row of the columns: channel, then the kernel's row and column.
template <typename T> __device__ void im2col(const T *x, T *columns, Window s) {
    int pixel = blockIdx.x * blockDim.x + threadIdx.x, pixels = s.rows * s.out_w;
    if (pixel >= pixels) return;
    int taps = s.kernel * s.kernel, channel = blockIdx.y / taps, tap = blockIdx.y % taps;
    int channels = gridDim.y / taps;
    int y = (s.row0 + pixel / s.out_w) * s.stride - s.pad + tap / s.kernel;
    int column = pixel % s.out_w * s.stride - s.pad + tap % s.kernel;
    bool inside = y >= 0 && y < s.h && column >= 0 && column < s.w;
    const T *plane = x + ((i64)blockIdx.z * channels + channel) * s.h * s.w;
    T *to = columns + ((i64)blockIdx.z * gridDim.y + blockIdx.y) * pixels + pixel;
    if (inside)
        *to = plane[(i64)y * s.w + column];
    else
        put(to, 0.0f);
}

// The same for a stride of 1 and a kernel of 3, and rows of a multiple of V pixels: a thread takes V pixels and the taps of
// a channel, which is blockIdx.y.
template <typename T, int V> __device__ void im2col_3(const T *x, T *columns, Window s) {
    int pixel = V * (blockIdx.x * blockDim.x + threadIdx.x), pixels = s.rows * s.out_w;
    if (pixel >= pixels) return;
    int first = pixel % s.out_w - s.pad;
    const T *plane = x + ((i64)blockIdx.z * gridDim.y + blockIdx.y) * s.h * s.w;
    T *to = columns + ((i64)blockIdx.z * gridDim.y + blockIdx.y) * 9 * pixels + pixel;
    for (int ky = 0; ky < 3; ky++) {
        int y = s.row0 + pixel / s.out_w - s.pad + ky;
        const T *row = plane + (i64)y * s.w;
        T seen[V + 2];
        for (int k = 0; k < V + 2; k++) {
            int at = first + k;
            if (y >= 0 && y < s.h && at >= 0 && at < s.w)
                seen[k] = row[at];
            else
                put(seen + k, 0.0f);
        }
        for (int kx = 0; kx < 3; kx++) {
            Pack<T, V> out;
            for (int k = 0; k < V; k++) out.v[k] = seen[k + kx];
            set(to + (i64)(3 * ky + kx) * pixels, out);
        }
    }
}

// As col2im for a stride of 1 and a kernel of 3, and rows of a multiple of V pixels.
template <typename T, int V> __device__ void col2im_3(const T *columns, T *dx, Window s, int first, int count) {
    int pixel = V * (blockIdx.x * blockDim.x + threadIdx.x);
    if (pixel >= count * s.w) return;
    int y = first + pixel / s.w, x = pixel % s.w;
    i64 pixels = s.rows * s.out_w, image = (i64)blockIdx.z * gridDim.y + blockIdx.y;
    T *to = dx + image * s.h * s.w + (i64)y * s.w + x;
    Pack<T, V> out = get<V>(to);
    float sum[V];
    for (int k = 0; k < V; k++) sum[k] = wide(out.v[k]);
    for (int ky = 0; ky < 3; ky++) {
        int oy = y + s.pad - ky - s.row0;
        if (oy < 0 || oy >= s.rows) continue;
        for (int kx = 0; kx < 3; kx++) {
            const T *from = columns + (image * 9 + 3 * ky + kx) * pixels + (i64)oy * s.out_w;
            int ox = x + s.pad - kx;
            for (int k = 0; k < V; k++)
                if (ox + k >= 0 && ox + k < s.out_w) sum[k] += wide(from[ox + k]);
        }
    }
    for (int k = 0; k < V; k++) put(out.v + k, sum[k]);
    set(to, out);
}

// Adds the columns to the rows of the input from `first` on. blockIdx.y is the channel.
template <typename T> __device__ void col2im(const T *columns, T *dx, Window s, int first, int count) {
    int pixel = blockIdx.x * blockDim.x + threadIdx.x;
    if (pixel >= count * s.w) return;
    int y = first + pixel / s.w, x = pixel % s.w, taps = s.kernel * s.kernel;
    i64 pixels = s.rows * s.out_w, image = (i64)blockIdx.z * gridDim.y + blockIdx.y;
    const T *from = columns + image * taps * pixels;
    float sum = 0.0f;
    for (int ky = 0; ky < s.kernel; ky++) {
        int oy = y + s.pad - ky;
        if (oy < 0 || oy % s.stride) continue;
        oy = oy / s.stride - s.row0;
        if (oy < 0 || oy >= s.rows) continue;
        for (int kx = 0; kx < s.kernel; kx++) {
            int ox = x + s.pad - kx;
            if (ox < 0 || ox % s.stride) continue;
            ox /= s.stride;
            if (ox < s.out_w) sum += wide(from[(ky * s.kernel + kx) * pixels + (i64)oy * s.out_w + ox]);
        }
    }
    T *to = dx + image * s.h * s.w + (i64)y * s.w + x;
    put(to, wide(*to) + sum);
}

// --- Element by element --------------------------------------------------------------------------------------------
// blockIdx.x is the row; blockIdx.y and the thread are the place in it.

__device__ int place() { return blockIdx.y * blockDim.x + threadIdx.x; }

// y += b: one value of b for each row, in turn over `channels`; with channels 0, one for each place.
template <typename T, int V> __device__ void add_bias(T *y, const T *b, int n, int channels) {
    int i = V * place();
    if (i >= n) return;
    T *to = y + (i64)blockIdx.x * n + i;
    Pack<T, V> out = get<V>(to);
    float same = channels ? wide(b[blockIdx.x % channels]) : 0.0f;
    for (int k = 0; k < V; k++) put(out.v + k, wide(out.v[k]) + (channels ? same : wide(b[i + k])));
    set(to, out);
}

__device__ float normal_below(float z) { return 0.5f * (1.0f + erff(z * 0.70710678f)); }

// value * gelu(gate) of rows (value, gate), n each.
template <typename T> __device__ void geglu(const T *x, T *y, int n) {
    int i = place();
    if (i >= n) return;
    i64 row = blockIdx.x;
    float value = wide(x[2 * row * n + i]), gate = wide(x[2 * row * n + n + i]);
    put(y + row * n + i, value * gate * normal_below(gate));
}

template <typename T> __device__ void geglu_vjp(const T *x, const T *g, T *dx, int n) {
    int i = place();
    if (i >= n) return;
    i64 row = blockIdx.x, at = 2 * row * n + i;
    float value = wide(x[at]), gate = wide(x[at + n]), gradient = wide(g[row * n + i]);
    float below = normal_below(gate), density = 0.39894228f * expf(-0.5f * gate * gate);
    put(dx + at, gradient * gate * below);
    put(dx + at + n, gradient * value * (below + gate * density));
}

// --- Training ------------------------------------------------------------------------------------------------------

// Sum of squares of n values; one block.
extern "C" __global__ void squares_f32(const float *x, double *sum, int n) {
    __shared__ double parts[256];
    double mine = 0.0;
    for (int i = threadIdx.x; i < n; i += blockDim.x) mine += (double)x[i] * x[i];
    parts[threadIdx.x] = mine;
    for (int half = blockDim.x / 2; half > 0; half /= 2) {
        __syncthreads();
        if (threadIdx.x < half) parts[threadIdx.x] += parts[threadIdx.x + half];
    }
    if (threadIdx.x == 0) *sum = parts[0];
}

// A step of AdamW [Loshchilov & Hutter 2019]: p, its moments, and its gradient before `scale`.
extern "C" __global__ void adamw_f32(float *p, float *first, float *second, const float *g, int n, float scale,
                                     float beta1, float beta2, float correction1, float correction2, float eps,
                                     float keep, float rate) {
    int i = blockIdx.x * blockDim.x + threadIdx.x;
    if (i >= n) return;
    float gradient = g[i] * scale;
    float m = first[i] * beta1 + gradient * (1.0f - beta1);
    float v = second[i] * beta2 + gradient * gradient * (1.0f - beta2);
    first[i] = m;
    second[i] = v;
    p[i] = p[i] * keep - rate * ((m / correction1) / (sqrtf(v / correction2) + eps));
}

// --- Entries -------------------------------------------------------------------------------------------------------

#define NORM_ARGUMENTS int n, int chunk, int groups, int per_group, int pixels, int silu, float eps
#define NORM (Norm{n, chunk, groups, per_group, pixels, silu, eps})
#define WINDOW_ARGUMENTS int h, int w, int kernel, int stride, int pad, int out_w, int row0, int rows
#define WINDOW (Window{h, w, kernel, stride, pad, out_w, row0, rows})

// norm_apply_8_bf16 takes eight values at once.
#define PACKED(T, S, V)                                                                                               \
    extern "C" __global__ void norm_sums_##V##_##S(const T *x, float *parts, int n, int chunk) {                      \
        norm_sums<T, V>(x, parts, n, chunk);                                                                          \
    }                                                                                                                 \
    extern "C" __global__ void norm_apply_##V##_##S(const T *x, const T *gamma, const T *beta, const float *parts,    \
                                                    T *y, NORM_ARGUMENTS) {                                           \
        norm_apply<T, V>(x, gamma, beta, parts, y, NORM);                                                             \
    }                                                                                                                 \
    extern "C" __global__ void norm_vjp_sums_##V##_##S(const T *x, const T *gamma, const T *beta, const float *parts, \
                                                       const T *g, float *sums, NORM_ARGUMENTS) {                     \
        norm_vjp_sums<T, V>(x, gamma, beta, parts, g, sums, NORM);                                                    \
    }                                                                                                                 \
    extern "C" __global__ void norm_vjp_##V##_##S(const T *x, const T *gamma, const T *beta, const float *parts,      \
                                                  const T *g, const float *sums, T *dx, NORM_ARGUMENTS) {             \
        norm_vjp<T, V>(x, gamma, beta, parts, g, sums, dx, NORM);                                                     \
    }                                                                                                                 \
    extern "C" __global__ void add_bias_##V##_##S(T *y, const T *b, int n, int channels) {                            \
        add_bias<T, V>(y, b, n, channels);                                                                            \
    }

#define ROWS(T, S, V)                                                                                                 \
    extern "C" __global__ void softmax_##V##_##S(const float *scores, T *p, int keys, int queries, int causal,        \
                                                 float scale) {                                                       \
        softmax<T, V>(scores, p, keys, queries, causal, scale);                                                       \
    }                                                                                                                 \
    extern "C" __global__ void softmax_vjp_##V##_##S(const T *p, const float *g, T *ds, int keys, float scale) {      \
        softmax_vjp<T, V>(p, g, ds, keys, scale);                                                                     \
    }

#define ENTRIES(T, S)                                                                                                 \
    PACKED(T, S, 1)                                                                                                   \
    PACKED(T, S, 8)                                                                                                   \
    ROWS(T, S, 1)                                                                                                     \
    ROWS(T, S, 4)                                                                                                     \
    extern "C" __global__ void im2col_##S(const T *x, T *columns, WINDOW_ARGUMENTS) { im2col(x, columns, WINDOW); }   \
    extern "C" __global__ void col2im_##S(const T *columns, T *dx, WINDOW_ARGUMENTS, int first, int count) {          \
        col2im(columns, dx, WINDOW, first, count);                                                                    \
    }                                                                                                                 \
    extern "C" __global__ void im2col_3_##S(const T *x, T *columns, WINDOW_ARGUMENTS) {                               \
        im2col_3<T, 8>(x, columns, WINDOW);                                                                           \
    }                                                                                                                 \
    extern "C" __global__ void col2im_3_##S(const T *columns, T *dx, WINDOW_ARGUMENTS, int first, int count) {        \
        col2im_3<T, 8>(columns, dx, WINDOW, first, count);                                                            \
    }                                                                                                                 \
    extern "C" __global__ void geglu_##S(const T *x, T *y, int n) { geglu(x, y, n); }                                 \
    extern "C" __global__ void geglu_vjp_##S(const T *x, const T *g, T *dx, int n) { geglu_vjp(x, g, dx, n); }

ENTRIES(float, f32)
ENTRIES(__half, f16)
ENTRIES(__nv_bfloat16, bf16)
