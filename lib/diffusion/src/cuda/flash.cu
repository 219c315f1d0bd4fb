// Attention of heads of 64 values on tensor cores, and its adjoint, without ever storing the scores: each block takes 128
// queries of a head over all keys, 64 at a time, and keeps the largest score and the sum so far [Dao 2023]. The adjoint
// computes the scores again, once by queries and once by keys, so that no sum is shared by blocks. For compute capability
// 8.0 on. `scale` is that of the scores times log2(e).
#include <cuda_bf16.h>
#include <cuda_fp16.h>

typedef long long i64;
typedef unsigned int u32;

constexpr int HEAD = 64, KEYS = 64, WARPS = 8, QUERIES = 16 * WARPS;
constexpr float LN_2 = 0.693147180559945f;
constexpr int PITCH = HEAD + 8; // Values from a stored row to the next: eight rows lie in different banks.

__device__ inline u32 pack(float a, float b, __nv_bfloat16) {
    __nv_bfloat162 v = __floats2bfloat162_rn(a, b);
    return *reinterpret_cast<u32 *>(&v);
}
__device__ inline u32 pack(float a, float b, __half) {
    __half2 v = __floats2half2_rn(a, b);
    return *reinterpret_cast<u32 *>(&v);
}

__device__ inline float2 unpack(u32 bits, __nv_bfloat16) {
    return __bfloat1622float2(*reinterpret_cast<__nv_bfloat162 *>(&bits));
}
__device__ inline float2 unpack(u32 bits, __half) { return __half22float2(*reinterpret_cast<__half2 *>(&bits)); }

// C += A B for A 16 x 16 and B 16 x 8.
__device__ inline void multiply(float *c, const u32 *a, u32 b0, u32 b1, __nv_bfloat16) {
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
                 : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
                 : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}
__device__ inline void multiply(float *c, const u32 *a, u32 b0, u32 b1, __half) {
    asm volatile("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
                 : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
                 : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
}

// Four 8 x 8 blocks; thread i gives the address of row i % 8 of block i / 8.
__device__ inline void load(u32 *r, const void *row) {
    u32 address = (u32)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
                 : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
                 : "r"(address)
                 : "memory");
}
__device__ inline void load_transposed(u32 *r, const void *row) {
    u32 address = (u32)__cvta_generic_to_shared(row);
    asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
                 : "=r"(r[0]), "=r"(r[1]), "=r"(r[2]), "=r"(r[3])
                 : "r"(address)
                 : "memory");
}

// Copies 16 bytes without waiting for them; zeros if there is nothing to copy.
__device__ inline void copy(void *to, const void *from, bool there) {
    u32 address = (u32)__cvta_generic_to_shared(to);
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16, %2;" ::"r"(address), "l"(from), "r"(there ? 16 : 0) : "memory");
}

// Rows first .. first + KEYS of a head into shared memory.
template <typename T> __device__ void fetch(T *to, const T *from, int first, int rows, i64 width) {
    for (int i = threadIdx.x; i < KEYS * HEAD / 8; i += 32 * WARPS) {
        int row = i / (HEAD / 8), column = i % (HEAD / 8) * 8;
        bool there = first + row < rows;
        copy(to + row * PITCH + column, from + (there ? first + row : 0) * width + column, there);
    }
}

// This thread's part of 16 rows as a left factor: rows row[0] and row[1] from `from`, zeros beyond `rows`.
template <typename T> __device__ void left(u32 (*to)[4], const T *from, const int *row, int rows, i64 width, int pair) {
    for (int s = 0; s < HEAD / 16; s++)
        for (int i = 0; i < 4; i++) {
            int r = row[i % 2], column = 16 * s + pair + i / 2 * 8;
            to[s][i] = r < rows ? *reinterpret_cast<const u32 *>(from + r * width + column) : 0;
        }
}

// 16 rows times the transpose of 64 stored rows.
template <typename T> __device__ void scores(float (*to)[4], const u32 (*rows)[4], const T *stored, int lane) {
    for (int n = 0; n < KEYS / 8; n++) {
        for (int i = 0; i < 4; i++) to[n][i] = 0.0f;
        for (int half = 0; half < HEAD / 32; half++) {
            u32 b[4];
            load(b, stored + (n * 8 + lane % 8) * PITCH + half * 32 + lane / 8 * 8);
            multiply(to[n], rows[2 * half], b[0], b[1], T());
            multiply(to[n], rows[2 * half + 1], b[2], b[3], T());
        }
    }
}

// Adds 16 rows of 64 weights times 64 stored rows.
template <typename T> __device__ void accumulate(float (*to)[4], const float (*weights)[4], const T *stored, int lane) {
    for (int s = 0; s < KEYS / 16; s++) {
        u32 weight[4];
        for (int i = 0; i < 4; i++) {
            const float *c = weights[2 * s + i / 2] + 2 * (i % 2);
            weight[i] = pack(c[0], c[1], T());
        }
        for (int n = 0; n < HEAD / 8; n += 2) {
            u32 b[4];
            load_transposed(b, stored + (s * 16 + lane % 16) * PITCH + (n + lane / 16) * 8);
            multiply(to[n], weight, b[0], b[1], T());
            multiply(to[n + 1], weight, b[2], b[3], T());
        }
    }
}

// Scores of keys that are not there.
__device__ inline void mask(float (*score)[4], int tile, int keys, int pair) {
    if ((tile + 1) * KEYS <= keys) return;
    for (int n = 0; n < KEYS / 8; n++)
        for (int i = 0; i < 4; i++)
            if (tile * KEYS + n * 8 + pair + i % 2 >= keys) score[n][i] = -INFINITY;
}

// Over the four threads that share a row.
__device__ inline float of_row(float sum) {
    sum += __shfl_xor_sync(0xffffffffu, sum, 1);
    return sum + __shfl_xor_sync(0xffffffffu, sum, 2);
}

// Rows row[0] and row[1] of a result.
template <typename T>
__device__ void write(T *to, const float (*values)[4], const float *factor, const int *row, int rows, i64 width, int pair) {
    for (int r = 0; r < 2; r++) {
        if (row[r] >= rows) continue;
        for (int n = 0; n < HEAD / 8; n++)
            *reinterpret_cast<u32 *>(to + row[r] * width + n * 8 + pair) =
                pack(values[n][2 * r] * factor[r], values[n][2 * r + 1] * factor[r], T());
    }
}

// Takes scores of row r in: they become weights of the largest so far, and what was summed before has to shrink by the result.
__device__ inline float renew(float (*score)[4], float *largest, float *sum, int r, float scale) {
    float top = *largest;
    for (int n = 0; n < KEYS / 8; n++) top = fmaxf(top, fmaxf(score[n][2 * r], score[n][2 * r + 1]));
    top = fmaxf(top, __shfl_xor_sync(0xffffffffu, top, 1));
    top = fmaxf(top, __shfl_xor_sync(0xffffffffu, top, 2));
    float shrink = exp2f((*largest - top) * scale);
    *largest = top;
    *sum *= shrink;
    for (int n = 0; n < KEYS / 8; n++)
        for (int i = 2 * r; i < 2 * r + 2; i++) {
            score[n][i] = exp2f((score[n][i] - top) * scale);
            *sum += score[n][i];
        }
    return shrink;
}

__device__ inline void end_of_copies() { asm volatile("cp.async.commit_group;" ::: "memory"); }
// All but the last group of copies.
__device__ inline void await_copies() {
    asm volatile("cp.async.wait_group 1;" ::: "memory");
    __syncthreads();
}

// blockIdx: queries, head, sample.
template <typename T>
__device__ void flash(const T *q, const T *k, const T *v, T *y, int queries, int keys, int heads, float scale) {
    __shared__ __align__(16) T shared_keys[2][KEYS * PITCH];
    __shared__ __align__(16) T shared_values[2][KEYS * PITCH];
    i64 width = (i64)heads * HEAD;
    i64 head = blockIdx.y * HEAD;
    q += blockIdx.z * queries * width + head;
    y += blockIdx.z * queries * width + head;
    k += blockIdx.z * keys * width + head;
    v += blockIdx.z * keys * width + head;
    int lane = threadIdx.x % 32, group = lane / 4, pair = lane % 4 * 2;
    // This thread's two rows.
    int row[2];
    row[0] = blockIdx.x * QUERIES + threadIdx.x / 32 * 16 + group;
    row[1] = row[0] + 8;
    u32 query[HEAD / 16][4];
    left(query, q, row, queries, width, pair);

    float out[HEAD / 8][4] = {}, largest[2] = {-INFINITY, -INFINITY}, sum[2] = {0.0f, 0.0f};
    int tiles = (keys + KEYS - 1) / KEYS;
    fetch(shared_keys[0], k, 0, keys, width);
    fetch(shared_values[0], v, 0, keys, width);
    end_of_copies();
    for (int tile = 0; tile < tiles; tile++) {
        int now = tile % 2;
        if (tile + 1 < tiles) {
            fetch(shared_keys[1 - now], k, (tile + 1) * KEYS, keys, width);
            fetch(shared_values[1 - now], v, (tile + 1) * KEYS, keys, width);
        }
        end_of_copies();
        await_copies();
        float score[KEYS / 8][4];
        scores(score, query, shared_keys[now], lane);
        mask(score, tile, keys, pair);
        for (int r = 0; r < 2; r++) {
            float shrink = renew(score, largest + r, sum + r, r, scale);
            for (int n = 0; n < HEAD / 8; n++) {
                out[n][2 * r] *= shrink;
                out[n][2 * r + 1] *= shrink;
            }
        }
        accumulate(out, score, shared_values[now], lane);
        __syncthreads(); // Before the next tile but one overwrites this one.
    }
    float factor[2];
    for (int r = 0; r < 2; r++) factor[r] = 1.0f / of_row(sum[r]);
    write(y, out, factor, row, queries, width, pair);
}

// The gradient at the queries, and what the kernel by keys needs of each: its largest score, what its weights are divided by,
// as a factor, and <g, y>. A logarithm of both would be rounded by more than a weight's precision where scores are large.
// blockIdx: queries, head, sample; `tops`, `shares` and `dots` are [samples, heads, queries].
template <typename T>
__device__ void flash_vjp_queries(const T *q, const T *k, const T *v, const T *y, const T *g, T *dq, float *tops,
                                  float *shares, float *dots, int queries, int keys, int heads, float scale) {
    __shared__ __align__(16) T shared_keys[2][KEYS * PITCH];
    __shared__ __align__(16) T shared_values[2][KEYS * PITCH];
    i64 width = (i64)heads * HEAD;
    i64 head = blockIdx.y * HEAD, of_queries = blockIdx.z * queries * width + head;
    q += of_queries;
    y += of_queries;
    g += of_queries;
    dq += of_queries;
    k += blockIdx.z * keys * width + head;
    v += blockIdx.z * keys * width + head;
    i64 of_rows = ((i64)blockIdx.z * heads + blockIdx.y) * queries;
    tops += of_rows;
    shares += of_rows;
    dots += of_rows;
    int lane = threadIdx.x % 32, group = lane / 4, pair = lane % 4 * 2;
    int row[2];
    row[0] = blockIdx.x * QUERIES + threadIdx.x / 32 * 16 + group;
    row[1] = row[0] + 8;
    u32 query[HEAD / 16][4], gradient[HEAD / 16][4];
    left(query, q, row, queries, width, pair);
    left(gradient, g, row, queries, width, pair);

    float dot[2] = {0.0f, 0.0f};
    {
        u32 result[HEAD / 16][4];
        left(result, y, row, queries, width, pair);
        for (int s = 0; s < HEAD / 16; s++)
            for (int i = 0; i < 4; i++) {
                float2 a = unpack(gradient[s][i], T()), b = unpack(result[s][i], T());
                dot[i % 2] += a.x * b.x + a.y * b.y;
            }
    }
    float score[KEYS / 8][4], largest[2] = {-INFINITY, -INFINITY}, sum[2] = {0.0f, 0.0f};
    int tiles = (keys + KEYS - 1) / KEYS;
    fetch(shared_keys[0], k, 0, keys, width);
    end_of_copies();
    for (int tile = 0; tile < tiles; tile++) {
        int now = tile % 2;
        if (tile + 1 < tiles) fetch(shared_keys[1 - now], k, (tile + 1) * KEYS, keys, width);
        end_of_copies();
        await_copies();
        scores(score, query, shared_keys[now], lane);
        mask(score, tile, keys, pair);
        for (int r = 0; r < 2; r++) renew(score, largest + r, sum + r, r, scale);
        __syncthreads();
    }
    float share[2];
    for (int r = 0; r < 2; r++) {
        dot[r] = of_row(dot[r]);
        share[r] = 1.0f / of_row(sum[r]);
        if (pair == 0 && row[r] < queries) {
            tops[row[r]] = largest[r];
            shares[row[r]] = share[r];
            dots[row[r]] = dot[r];
        }
    }

    float out[HEAD / 8][4] = {};
    fetch(shared_keys[0], k, 0, keys, width);
    fetch(shared_values[0], v, 0, keys, width);
    end_of_copies();
    for (int tile = 0; tile < tiles; tile++) {
        int now = tile % 2;
        if (tile + 1 < tiles) {
            fetch(shared_keys[1 - now], k, (tile + 1) * KEYS, keys, width);
            fetch(shared_values[1 - now], v, (tile + 1) * KEYS, keys, width);
        }
        end_of_copies();
        await_copies();
        float at_weights[KEYS / 8][4];
        scores(score, query, shared_keys[now], lane);
        mask(score, tile, keys, pair);
        scores(at_weights, gradient, shared_values[now], lane);
        for (int n = 0; n < KEYS / 8; n++)
            for (int i = 0; i < 4; i++)
                score[n][i] = exp2f((score[n][i] - largest[i / 2]) * scale) * share[i / 2] * (at_weights[n][i] - dot[i / 2]);
        accumulate(out, score, shared_keys[now], lane);
        __syncthreads();
    }
    float factor[2] = {scale * LN_2, scale * LN_2};
    write(dq, out, factor, row, queries, width, pair);
}

// The gradients at keys and values, from what the kernel by queries left. blockIdx: keys, head, sample.
template <typename T>
__device__ void flash_vjp_keys(const T *q, const T *k, const T *v, const T *g, const float *tops, const float *shares,
                               const float *dots, T *dk, T *dv, int queries, int keys, int heads, float scale) {
    __shared__ __align__(16) T shared_queries[2][KEYS * PITCH];
    __shared__ __align__(16) T shared_gradients[2][KEYS * PITCH];
    __shared__ float shared_tops[2][KEYS], shared_shares[2][KEYS], shared_dots[2][KEYS];
    i64 width = (i64)heads * HEAD;
    i64 head = blockIdx.y * HEAD, of_keys = blockIdx.z * keys * width + head;
    q += blockIdx.z * queries * width + head;
    g += blockIdx.z * queries * width + head;
    k += of_keys;
    v += of_keys;
    dk += of_keys;
    dv += of_keys;
    i64 of_rows = ((i64)blockIdx.z * heads + blockIdx.y) * queries;
    tops += of_rows;
    shares += of_rows;
    dots += of_rows;
    int lane = threadIdx.x % 32, group = lane / 4, pair = lane % 4 * 2;
    int row[2];
    row[0] = blockIdx.x * QUERIES + threadIdx.x / 32 * 16 + group;
    row[1] = row[0] + 8;
    u32 key[HEAD / 16][4], value[HEAD / 16][4];
    left(key, k, row, keys, width, pair);
    left(value, v, row, keys, width, pair);

    auto fetch_queries = [&](int to, int tile) {
        fetch(shared_queries[to], q, tile * KEYS, queries, width);
        fetch(shared_gradients[to], g, tile * KEYS, queries, width);
        if (threadIdx.x < KEYS) {
            int query = tile * KEYS + threadIdx.x;
            // A query that is not there has no weights.
            shared_tops[to][threadIdx.x] = query < queries ? tops[query] : INFINITY;
            shared_shares[to][threadIdx.x] = query < queries ? shares[query] : 0.0f;
            shared_dots[to][threadIdx.x] = query < queries ? dots[query] : 0.0f;
        }
        end_of_copies();
    };
    float at_key[HEAD / 8][4] = {}, at_value[HEAD / 8][4] = {};
    int tiles = (queries + KEYS - 1) / KEYS;
    fetch_queries(0, 0);
    for (int tile = 0; tile < tiles; tile++) {
        int now = tile % 2;
        if (tile + 1 < tiles)
            fetch_queries(1 - now, tile + 1);
        else
            end_of_copies();
        await_copies();
        float weight[KEYS / 8][4], at_weight[KEYS / 8][4];
        scores(weight, key, shared_queries[now], lane);
        for (int n = 0; n < KEYS / 8; n++)
            for (int i = 0; i < 4; i++) {
                int query = n * 8 + pair + i % 2;
                weight[n][i] = exp2f((weight[n][i] - shared_tops[now][query]) * scale) * shared_shares[now][query];
            }
        accumulate(at_value, weight, shared_gradients[now], lane);
        scores(at_weight, value, shared_gradients[now], lane);
        for (int n = 0; n < KEYS / 8; n++)
            for (int i = 0; i < 4; i++) weight[n][i] *= at_weight[n][i] - shared_dots[now][n * 8 + pair + i % 2];
        accumulate(at_key, weight, shared_queries[now], lane);
        __syncthreads();
    }
    float one[2] = {1.0f, 1.0f}, factor[2] = {scale * LN_2, scale * LN_2};
    write(dv, at_value, one, row, keys, width, pair);
    write(dk, at_key, factor, row, keys, width, pair);
}

#define ENTRIES(T, S)                                                                                                 \
    extern "C" __global__ void __launch_bounds__(32 * WARPS)                                                          \
        flash_##S(const T *q, const T *k, const T *v, T *y, int queries, int keys, int heads, float scale) {          \
        flash(q, k, v, y, queries, keys, heads, scale);                                                               \
    }                                                                                                                 \
    extern "C" __global__ void __launch_bounds__(32 * WARPS)                                                          \
        flash_vjp_queries_##S(const T *q, const T *k, const T *v, const T *y, const T *g, T *dq, float *tops,         \
                              float *shares, float *dots, int queries, int keys, int heads, float scale) {            \
        flash_vjp_queries(q, k, v, y, g, dq, tops, shares, dots, queries, keys, heads, scale);                        \
    }                                                                                                                 \
    extern "C" __global__ void __launch_bounds__(32 * WARPS)                                                          \
        flash_vjp_keys_##S(const T *q, const T *k, const T *v, const T *g, const float *tops, const float *shares,    \
                           const float *dots, T *dk, T *dv, int queries, int keys, int heads, float scale) {          \
        flash_vjp_keys(q, k, v, g, tops, shares, dots, dk, dv, queries, keys, heads, scale);                          \
    }

ENTRIES(__half, f16)
ENTRIES(__nv_bfloat16, bf16)
